"""Narrowing each parameter: the mean of their relative variances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.criteria.base import DesignCriterion
from cluster_est.experiment_design.criteria.d_optimal import covariances
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.prediction import PredictedExperiment


class AOptimality(DesignCriterion):
    """How many times smaller the mean standard error gets, as a logarithm.

    The trace of the covariance, with each parameter in units of the standard error that it has
    before: A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS
    (2007), chapter 10.
    """

    name: ClassVar[str] = "a"
    compares: ClassVar[bool] = False
    called: ClassVar[str] = "smaller standard errors (log)"

    @override
    def value(
        self,
        models: Sequence[FittedCandidate],
        predicted: Sequence[PredictedExperiment],
        parameters: Sequence[str],
    ) -> float:
        before, after = covariances(models[0], predicted[0], parameters)
        return -0.5 * float(np.log(np.mean(np.diag(after) / np.diag(before))))
