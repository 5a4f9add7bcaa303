"""Criteria: how much an experiment is worth before it has been made.

A new one is a class here that is derived from `DesignCriterion`, and a name in `CRITERIA`.
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
    """A measure of what an experiment will tell."""

    name: ClassVar[str]
    """As in a file of limits."""

    compares: ClassVar[bool]
    """Whether it compares models, and so needs two; the others look at the first one alone."""

    predicts: ClassVar[bool] = False
    """Whether it needs to know what is to be predicted: `FittedCandidate.targets`."""

    called: ClassVar[str]
    """What a table calls its value, with the unit."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        """Return the worth of an experiment; more is better.

        Parameters
        ----------
        models, predicted
            The models, and what each predicts of the experiment.
        parameters
            Labels of the unknowns of the first model that count.
        """


class DOptimality(DesignCriterion):
    """How many times smaller the confidence region of the parameters gets, as a logarithm.

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
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        before, after = covariances(models[0], predicted[0], parameters)
        return -0.5 * float(np.log(np.mean(np.diag(after) / np.diag(before))))


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
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
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


class Discrimination(DesignCriterion):
    """The probability of the true model after the experiment, as a mean over the models.

    Each is as likely to be the true one as the data so far say. As probabilities of structures
    are, it is made of evidence divided by `CRITERION_SCALE`, for no model is exact. A rival that no
    input can tell apart, such as one that holds the true model as a special case, takes the same
    from every experiment; one that is ruled out already adds nothing.

    With the outputs y of a model i distributed as N(f_i, S_i), S_i the noise and what the
    uncertainty of its parameters adds, a rival j that is fitted again to all data leaves a sum of
    squares of (y - f_j)' S_j^-1 (y - f_j) more. If i is the true one, the log likelihood of j is
    expected to fall behind by

        E_ij = (d' S_j^-1 d + tr(S_j^-1 S_i) - n) / 2,    d = f_i - f_j,

    which is T-optimality (A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975) 57-70,
    doi:10.1093/biomet/62.1.57) with what earlier data say of the parameters. Its exponential is how
    many times less likely j will be. The determinants that a marginal likelihood has besides
    (G. E. P. Box, W. J. Hill, Technometrics 9 (1967) 57-71, doi:10.1080/00401706.1967.10490441) are
    left out: where nothing is known of a parameter they would count as evidence.
    """

    name: ClassVar[str] = "discriminate"
    compares: ClassVar[bool] = True
    called: ClassVar[str] = "expected probability of the true model"

    @override
    def value(self, models: Models, predicted: Predictions, parameters: Sequence[str]) -> float:
        del parameters  # all models count as they are
        weights = np.array([fitted.model.weight for fitted in models])
        expected = expected_probabilities(evidence_table(predicted), weights)
        return float(np.average(expected, weights=weights))


def expected_probabilities(evidence: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the probability of each model after an experiment, if it is the true one.

    Parameters
    ----------
    evidence : (true model, rival)
        Expected differences of log likelihoods.
    weights : (models,)
        Probabilities before.
    """
    rivals = weights * np.exp(-np.maximum(evidence, 0.0) / CRITERION_SCALE)
    np.fill_diagonal(rivals, weights)
    return np.asarray(weights / np.add.reduce(rivals, axis=1))


def evidence_table(predicted: Predictions) -> FloatArray:
    """Return (true model, rival): the evidence that an experiment is expected to give."""
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
    """S = 1 + F F', of many samples and few unknowns (M. A. Woodbury's formula)."""

    def __init__(self, factor: FloatArray) -> None:
        self._factor = factor
        self._inner = np.eye(factor.shape[1]) + factor.T @ factor

    def solve(self, vector: FloatArray) -> FloatArray:
        """Return S^-1 v."""
        inner = np.linalg.solve(self._inner, self._factor.T @ vector)
        return np.asarray(vector - self._factor @ inner)

    def trace_of_inverse_with(self, other: FloatArray) -> float:
        """Return tr(S^-1 (1 + G G')) of another factor G."""
        own, cross = self._factor.T @ self._factor, self._factor.T @ other
        of_identity = len(self._factor) - float(np.trace(np.linalg.solve(self._inner, own)))
        of_other = float(np.sum(other**2))
        of_other -= float(np.sum(cross * np.linalg.solve(self._inner, cross)))
        return of_identity + of_other


CRITERIA: dict[str, DesignCriterion] = {
    criterion.name: criterion
    for criterion in (Discrimination(), DOptimality(), AOptimality(), VOptimality())
}
