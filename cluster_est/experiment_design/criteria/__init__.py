"""Every criterion by its name; a new one is a file beside these and a line here."""

from __future__ import annotations

from cluster_est.experiment_design.criteria.a_optimal import AOptimality
from cluster_est.experiment_design.criteria.base import DesignCriterion
from cluster_est.experiment_design.criteria.d_optimal import DOptimality, covariances
from cluster_est.experiment_design.criteria.discriminate import (
    Discrimination,
    evidence_table,
    expected_probabilities,
)
from cluster_est.experiment_design.criteria.v_optimal import VOptimality, prediction_variances

CRITERIA: dict[str, DesignCriterion] = {
    criterion.name: criterion
    for criterion in (Discrimination(), DOptimality(), AOptimality(), VOptimality())
}

__all__ = [
    "CRITERIA",
    "DesignCriterion",
    "covariances",
    "evidence_table",
    "expected_probabilities",
    "prediction_variances",
]
