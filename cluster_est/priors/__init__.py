"""Priors: what is known of a parameter before the measurements. One file a family.

A new prior is one file with a subclass of `Prior` and one line here.
"""

from __future__ import annotations

from cluster_est.priors.base import Prior
from cluster_est.priors.lognormal import LogNormalPrior
from cluster_est.priors.normal import NormalPrior

PRIORS: dict[str, type[Prior]] = {
    NormalPrior.name: NormalPrior,
    LogNormalPrior.name: LogNormalPrior,
}

__all__ = ["PRIORS", "LogNormalPrior", "NormalPrior", "Prior"]
