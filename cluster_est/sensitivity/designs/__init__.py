"""All designs by name; a new design is a file in this folder and a line here."""

from __future__ import annotations

from cluster_est.sensitivity.designs.base import SensitivityDesign, SensitivityIndex
from cluster_est.sensitivity.designs.morris import MorrisDesign
from cluster_est.sensitivity.designs.sobol import SobolDesign

DESIGNS: dict[str, SensitivityDesign] = {
    design.name: design for design in (MorrisDesign(), SobolDesign())
}

__all__ = ["DESIGNS", "SensitivityDesign", "SensitivityIndex"]
