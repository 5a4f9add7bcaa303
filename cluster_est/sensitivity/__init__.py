"""Sensitivity analysis: which unknowns matter, where in the data, and which go together."""

from __future__ import annotations

from cluster_est.sensitivity.analysis import analyse_sensitivity, sensitivity
from cluster_est.sensitivity.result import SensitivityResult
from cluster_est.sensitivity.settings import SensitivitySettings

__all__ = ["SensitivityResult", "SensitivitySettings", "analyse_sensitivity", "sensitivity"]
