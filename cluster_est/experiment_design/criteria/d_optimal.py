"""Narrowing parameters together: the volume of their confidence region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.criteria.base import DesignCriterion
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.prediction import PredictedExperiment
from cluster_est.statistics.projection import inverse, log_determinant
from workers.messages import FloatArray, IntArray


class DOptimality(DesignCriterion):
    """How many times smaller the confidence region of the parameters gets, as a logarithm.

    Half the difference of the log determinants of their covariance before and after: A. C.
    Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS (2007), chapter 11.
    It does not depend on the units of the parameters.
    """

    name: ClassVar[str] = "d"
    compares: ClassVar[bool] = False
    called: ClassVar[str] = "smaller volume of the parameters' region (log)"

    @override
    def value(
        self,
        models: Sequence[FittedCandidate],
        predicted: Sequence[PredictedExperiment],
        parameters: Sequence[str],
    ) -> float:
        before, after = covariances(models[0], predicted[0], parameters)
        return 0.5 * (log_determinant(before) - log_determinant(after))


def covariances(
    fitted: FittedCandidate, predicted: PredictedExperiment, parameters: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of some unknowns before and after an experiment.

    Each (parameters, parameters), in search coordinates, with whatever else is unknown estimated
    along.
    """
    before = fitted.covariance
    there = _places(fitted.labels, parameters)
    shared = [label for label in predicted.labels if label in fitted.labels]
    own = _places(predicted.labels, shared)
    gained = inverse(predicted.posterior[np.ix_(own, own)])
    gained -= inverse(inverse(predicted.information)[np.ix_(own, own)])
    information = fitted.information.copy()
    of_shared = _places(fitted.labels, shared)
    information[np.ix_(of_shared, of_shared)] += gained
    after = inverse(information)
    return before[np.ix_(there, there)], after[np.ix_(there, there)]


def _places(labels: Sequence[str], wanted: Sequence[str]) -> IntArray:
    return np.array([labels.index(label) for label in wanted], np.intp)
