"""Every design by its name; a new one is a file beside these and a line here."""

from __future__ import annotations

from cluster_est.sensitivity.designs.base import SensitivityDesign, SensitivityIndex
from cluster_est.sensitivity.designs.morris import MorrisDesign
from cluster_est.sensitivity.designs.sobol import SobolDesign

DESIGNS: dict[str, SensitivityDesign] = {
    design.name: design for design in (MorrisDesign(), SobolDesign())
}

__all__ = ["DESIGNS", "SensitivityDesign", "SensitivityIndex"]
