"""What an experiment is expected to tell: evidence, probabilities, standard errors, outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.experiment_design.candidates import RANDOM, RECORDED, SMALLER
from cluster_est.experiment_design.criteria import (
    covariances,
    expected_probabilities,
    prediction_variances,
)
from cluster_est.experiment_design.findings.expected_rows import (
    ExpectedEvidence,
    ExpectedPrecision,
    ExpectedPredictionError,
    ExpectedProbability,
)
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.search import CandidateScorer, ScoredCandidate, ranked
from workers.messages import FloatArray


def expected_table(models: Sequence[FittedCandidate], best: ScoredCandidate) -> pa.Table:
    """What each model predicts of each output, with the error that its parameters make of it."""
    experiment = best.candidate.experiment
    columns: dict[str, list[Any]] = {
        name: [] for name in ("model", "output", "time", "expected", "std_error")
    }
    for fitted, predicted in zip(models, best.predicted, strict=True):
        errors = np.sqrt(np.sum(predicted.factor**2, axis=1))
        first = 0
        for output in experiment.outputs:
            count = len(output.times)
            rows = slice(first, first + count)
            columns["model"] += [fitted.model.name] * count
            columns["output"] += [output.variable] * count
            columns["time"] += output.times.tolist()
            columns["expected"] += (output.sigma * predicted.outputs[rows]).tolist()
            columns["std_error"] += (output.sigma * errors[rows]).tolist()
            first += count
    return pa.table(columns)


def expected_evidence(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], own: FloatArray
) -> tuple[ExpectedEvidence, ...]:
    """Return the evidence for every pair of models; none where there is one model.

    `own` is that of the chosen input, (true model, rival).
    """
    if len(scorer.models) < 2:
        return ()
    names = [fitted.model.name for fitted in scorer.models]
    random, recorded = _compared(found, lambda each: each.evidence)
    most = np.maximum(_largest_evidence(found), own)
    return tuple(
        ExpectedEvidence(
            names[i],
            names[j],
            *(float(each[i, j]) for each in (own, random, recorded, most)),
        )
        for i in range(len(names))
        for j in range(len(names))
        if i != j
    )


def expected_probability(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], own: FloatArray
) -> tuple[ExpectedProbability, ...]:
    """Return the probability of every model, if it is right; none where there is one model."""
    if len(scorer.models) < 2:
        return ()
    weights = np.array([fitted.model.weight for fitted in scorer.models])

    def expected(each: ScoredCandidate) -> FloatArray:
        return expected_probabilities(each.evidence, weights)

    after = expected_probabilities(own, weights)
    columns = (weights / np.add.reduce(weights), after, *_compared(found, expected))
    return tuple(
        ExpectedProbability(fitted.model.name, *(float(column[i]) for column in columns))
        for i, fitted in enumerate(scorer.models)
    )


def expected_precision(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], best: ScoredCandidate
) -> tuple[ExpectedPrecision, ...]:
    """Return the standard error of every parameter that counts, before and after."""
    fitted, labels = scorer.models[0], scorer.parameters

    def errors(each: ScoredCandidate) -> FloatArray:
        after = covariances(fitted, each.predicted[0], labels)[1]
        return np.sqrt(np.diag(after))

    before = np.sqrt(np.diag(covariances(fitted, best.predicted[0], labels)[0]))
    after = errors(best)
    random, recorded = _compared(found, errors)
    rows = []
    for place, label in enumerate(labels):
        i = fitted.labels.index(label)
        unknown, searched = fitted.space.unknowns[i], float(fitted.x[i])
        unit = _physical_change(unknown.to_physical, searched)
        rows.append(
            ExpectedPrecision(
                label,
                unknown.parameter.unit,
                unknown.to_physical(searched),
                *(unit * float(each[place]) for each in (before, after, random, recorded)),
            )
        )
    return tuple(rows)


def expected_predictions(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], best: ScoredCandidate
) -> tuple[ExpectedPredictionError, ...]:
    """Return the standard deviation of every prediction that counts, before and after."""
    fitted = scorer.models[0]
    if not fitted.targets:
        return ()

    def errors(each: ScoredCandidate) -> FloatArray:
        return np.sqrt(prediction_variances(fitted, each.predicted[0])[1])

    before = np.sqrt(prediction_variances(fitted, best.predicted[0])[0])
    columns = (before, errors(best), *_compared(found, errors))
    return tuple(
        ExpectedPredictionError(
            each.experiment, each.output, each.unit, *(float(column[i]) for column in columns)
        )
        for i, each in enumerate(fitted.targets)
    )


def _physical_change(to_physical: Callable[[float], float], searched: float) -> float:
    """The derivative of a physical value by the one that is searched."""
    step = 1e-6 * max(abs(searched), 1.0)
    return abs(to_physical(searched + step) - to_physical(searched - step)) / (2.0 * step)


def _largest_evidence(found: Sequence[ScoredCandidate]) -> FloatArray:
    """(true model, rival): the largest evidence that any input is expected to give."""
    return np.asarray(np.max([each.evidence for each in ranked(found)], axis=0))


def _compared(
    found: Sequence[ScoredCandidate], measure: Callable[[ScoredCandidate], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """A measure of the median random input, and of the best recorded one; NaN without any."""
    nothing = np.full(measure(ranked(found)[0]).shape, np.nan)
    random = ranked([each for each in found if each.candidate.origin in (RANDOM, SMALLER)])
    recorded = ranked([each for each in found if each.candidate.origin == RECORDED])
    return (
        measure(random[len(random) // 2]) if random else nothing,
        measure(recorded[0]) if recorded else nothing,
    )
