"""Narrowing what is predicted: the mean variance of predictions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.criteria.base import DesignCriterion
from cluster_est.experiment_design.criteria.d_optimal import covariances
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.prediction import PredictedExperiment
from workers.messages import FloatArray


class VOptimality(DesignCriterion):
    """How many times smaller the standard deviation of predictions gets, as a logarithm.

    The variance that the parameters give an output, j' C j with j its derivatives and C their
    covariance, as a mean over its samples and over what it is before, as a mean over the outputs:
    A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS (2007),
    chapter 10 (V-optimality; with an integral in place of the samples I-optimality).
    """

    name: ClassVar[str] = "v"
    compares: ClassVar[bool] = False
    predicts: ClassVar[bool] = True
    called: ClassVar[str] = "smaller standard deviations of predictions (log)"

    @override
    def value(
        self,
        models: Sequence[FittedCandidate],
        predicted: Sequence[PredictedExperiment],
        parameters: Sequence[str],
    ) -> float:
        del parameters  # all of them make what is predicted uncertain
        before, after = prediction_variances(models[0], predicted[0])
        return -0.5 * float(np.log(np.mean(after / before)))


def prediction_variances(
    fitted: FittedCandidate, predicted: PredictedExperiment
) -> tuple[FloatArray, FloatArray]:
    """Return the mean variance of each target before and after an experiment, (targets,)."""
    pair = covariances(fitted, predicted, fitted.labels)
    before, after = (
        np.array([float(np.add.reduce((each.squares * matrix).ravel())) for each in fitted.targets])
        for matrix in pair
    )
    return before, after
