"""Criteria for the value of an experiment before it is made.

To add a criterion, derive a class from `DesignCriterion` here, and add its name to `CRITERIA`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.closed_loop.findings.competing_models import CRITERION_SCALE
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.predicted_outputs import PredictedExperiment
from cluster_est.plug_in import check_class_attributes
from cluster_est.statistics.projection import inverse, log_determinant
from workers.messages import FloatArray, IntArray

Models = Sequence[FittedCandidate]
Predictions = Sequence[PredictedExperiment]


class DesignCriterion(ABC):
    """A measure of the expected information of an experiment."""

    name: ClassVar[str]
    """Name in a limits file."""

    compares: ClassVar[bool]
    """Whether it compares at least two models; other criteria use only the first model."""

    predicts: ClassVar[bool] = False
    """Whether it needs outputs to predict: `FittedCandidate.targets`."""

    called: ClassVar[str]
    """Name of its value in a table, with the unit."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        """Return the value of an experiment; a larger value is better.

        Parameters
        ----------
        models, predicted
            The models, and the prediction of each model for the experiment.
        parameters
            Labels of the unknowns of the first model that count.
        """


class DOptimality(DesignCriterion):
    """Factor by which the confidence region of the parameters shrinks, as a logarithm.

    Half the difference of the log determinants of their covariance before and after: A. C.
    Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS (2007), chapter 11.
    It does not depend on the units of the parameters.
    """

    name: ClassVar[str] = "d"
    compares: ClassVar[bool] = False
    called: ClassVar[str] = "smaller volume of the confidence region of the parameters (log)"

    @override
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        before, after = covariances(models[0], predicted[0], parameters)
        return 0.5 * (log_determinant(before) - log_determinant(after))


def covariances(
    fitted: FittedCandidate, predicted: PredictedExperiment, parameters: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of some unknowns before and after an experiment.

    Each is (parameters, parameters), in search coordinates; the other unknowns are estimated too.
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


class AOptimality(DesignCriterion):
    """Factor by which the mean standard error shrinks, as a logarithm.

    The trace of the covariance, with each parameter in units of its previous standard error: A. C.
    Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS (2007), chapter 10.
    """

    name: ClassVar[str] = "a"
    compares: ClassVar[bool] = False
    called: ClassVar[str] = "smaller standard errors (log)"

    @override
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        before, after = covariances(models[0], predicted[0], parameters)
        return -0.5 * float(np.log(np.mean(np.diag(after) / np.diag(before))))


class VOptimality(DesignCriterion):
    """Factor by which the standard deviation of predictions shrinks, as a logarithm.

    The parameters give an output the variance j' C j, with its derivatives j and their covariance
    C. This is averaged over the samples, divided by its previous value, and averaged over the
    outputs: A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS
    (2007), chapter 10 (V-optimality; with an integral instead of the samples I-optimality).
    """

    name: ClassVar[str] = "v"
    compares: ClassVar[bool] = False
    predicts: ClassVar[bool] = True
    called: ClassVar[str] = "smaller standard deviations of predictions (log)"

    @override
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        del parameters  # all parameters contribute to the uncertainty of a prediction
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


class Discrimination(DesignCriterion):
    """The expected probability of the true model after the experiment, averaged over the models.

    Each model is true with its current probability. Like the probabilities of structures, it is
    computed from evidence divided by `CRITERION_SCALE`, because no model is exact. Some rivals
    cannot be distinguished by any input, for example a rival that contains the true model as a
    special case. Such a rival reduces the value of every experiment equally. A rival that is
    already excluded has no influence.

    Let the outputs y of a model i be distributed as N(f_i, S_i). S_i contains the noise and the
    uncertainty of its parameters. A rival j that is refitted to all data increases its sum of
    squares by (y - f_j)' S_j^-1 (y - f_j). If i is true, the log likelihood of j is expected to be
    lower by

        E_ij = (d' S_j^-1 d + tr(S_j^-1 S_i) - n) / 2,    d = f_i - f_j,

    which is T-optimality (A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975) 57-70,
    doi:10.1093/biomet/62.1.57) including the information of earlier data on the parameters. Its
    exponential is the factor by which j becomes less likely. The determinants of a marginal
    likelihood (G. E. P. Box, W. J. Hill, Technometrics 9 (1967) 57-71,
    doi:10.1080/00401706.1967.10490441) are omitted, because they would count as evidence if nothing
    is known about a parameter.
    """

    name: ClassVar[str] = "discriminate"
    compares: ClassVar[bool] = True
    called: ClassVar[str] = "expected probability of the true model"

    @override
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        del parameters  # all models count equally
        weights = np.array([fitted.model.weight for fitted in models])
        expected = expected_probabilities(evidence_table(predicted), weights)
        return float(np.average(expected, weights=weights))


def expected_probabilities(evidence: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the probability of each model after an experiment, if it is the true model.

    Parameters
    ----------
    evidence : (true model, rival)
        Expected differences of log likelihoods.
    weights : (models,)
        Probabilities before the experiment.
    """
    rivals = weights * np.exp(-np.maximum(evidence, 0.0) / CRITERION_SCALE)
    np.fill_diagonal(rivals, weights)
    return np.asarray(weights / np.add.reduce(rivals, axis=1))


def evidence_table(predicted: Predictions) -> FloatArray:
    """Return the expected evidence of an experiment, (true model, rival)."""
    outputs = [each.outputs for each in predicted]
    factors = [each.factor for each in predicted]
    found = np.zeros((len(predicted), len(predicted)))
    for j in range(len(predicted)):
        rival = _NoiseCovariance(factors[j])
        for i in range(len(predicted)):
            if i == j:
                continue
            off = outputs[i] - outputs[j]
            trace = rival.trace_of_inverse_with(factors[i]) - len(off)
            found[i, j] = 0.5 * (trace + float(off @ rival.solve(off)))
    return found


class _NoiseCovariance:
    """S = 1 + F F' for many samples and few unknowns (M. A. Woodbury's formula)."""

    def __init__(self, factor: FloatArray) -> None:
        self._factor = factor
        self._inner = np.eye(factor.shape[1]) + factor.T @ factor

    def solve(self, vector: FloatArray) -> FloatArray:
        """Return S^-1 v."""
        inner = np.linalg.solve(self._inner, self._factor.T @ vector)
        return np.asarray(vector - self._factor @ inner)

    def trace_of_inverse_with(self, other: FloatArray) -> float:
        """Return tr(S^-1 (1 + G G')) for another factor G."""
        own, cross = self._factor.T @ self._factor, self._factor.T @ other
        of_identity = len(self._factor) - float(np.trace(np.linalg.solve(self._inner, own)))
        of_other = float(np.sum(other**2))
        of_other -= float(np.sum(cross * np.linalg.solve(self._inner, cross)))
        return of_identity + of_other


CRITERIA: dict[str, DesignCriterion] = {
    criterion.name: criterion
    for criterion in (Discrimination(), DOptimality(), AOptimality(), VOptimality())
}
