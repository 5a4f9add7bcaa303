"""Telling models apart: the probability that the true one is expected to have afterwards.

With the outputs y of a model i distributed as N(f_i, S_i), S_i the noise and what the uncertainty
of its parameters adds, a rival j that is fitted again to all data leaves a sum of squares of
(y - f_j)' S_j^-1 (y - f_j) more. If i is the true one, the log likelihood of j is expected to fall
behind by

    E_ij = (d' S_j^-1 d + tr(S_j^-1 S_i) - n) / 2,    d = f_i - f_j,

which is T-optimality (A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975) 57-70,
doi:10.1093/biomet/62.1.57) with what earlier data say of the parameters. Its exponential is how
many times less likely j will be. The determinants that a marginal likelihood has besides (G. E. P.
Box, W. J. Hill, Technometrics 9 (1967) 57-71, doi:10.1080/00401706.1967.10490441) are left out:
where nothing is known of a parameter they would count as evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.closed_loop.findings.structure_probabilities import TEMPERATURE
from cluster_est.experiment_design.criteria.base import DesignCriterion
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.prediction import PredictedExperiment
from workers.messages import FloatArray


class Discrimination(DesignCriterion):
    """The probability of the true model after the experiment, as a mean over the models.

    Each is as likely to be the true one as the data so far say. As probabilities of structures
    are, it is made of evidence divided by `TEMPERATURE`, for no model is exact. A rival that no
    input can tell apart, such as one that holds the true model as a special case, takes the same
    from every experiment; one that is ruled out already adds nothing.
    """

    name: ClassVar[str] = "discriminate"
    compares: ClassVar[bool] = True
    called: ClassVar[str] = "expected probability of the true model"

    @override
    def value(
        self,
        models: Sequence[FittedCandidate],
        predicted: Sequence[PredictedExperiment],
        parameters: Sequence[str],
    ) -> float:
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
    rivals = weights * np.exp(-np.maximum(evidence, 0.0) / TEMPERATURE)
    np.fill_diagonal(rivals, weights)
    return np.asarray(weights / np.add.reduce(rivals, axis=1))


def evidence_table(predicted: Sequence[PredictedExperiment]) -> FloatArray:
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
