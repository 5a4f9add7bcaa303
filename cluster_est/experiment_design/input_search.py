"""Search for an input: random candidates, then changes of the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.errors import BudgetError, ProblemError
from cluster_est.experiment_design.candidate_inputs import CandidateInput, CandidateMaker
from cluster_est.experiment_design.criteria import DesignCriterion, evidence_table
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.predicted_outputs import (
    DesignQueue,
    PredictedExperiment,
    keeping_limits,
    predictions,
)
from cluster_est.methods.method import TOLERANCE
from cluster_est.running.runner import Runner
from workers.messages import FloatArray

RANDOM_SHARE = 0.5
"""Share of random candidates; the others are changes of the best."""
REFINEMENT_ROUNDS = ((0.2, 6), (0.1, 4), (0.05, 3))
"""Size of the changes in each round, and number of best candidates that are changed."""
SHRINKING = (0.3, 0.1, 0.03)
"""Factors of the amplitudes to try if too few candidates satisfy the limits."""
FEWEST_KEPT = 3


@dataclass(frozen=True)
class ScoredCandidate:
    """A candidate and its value.

    Attributes
    ----------
    candidate
        The candidate.
    value
        Value of the criterion; NaN if limits are violated or a simulation fails.
    violation
        Largest violation of a limit at the estimates. NaN if a simulation failed, or if limits are
        violated only with other parameters.
    why
        The violated limit, or why it cannot be simulated; "" if neither.
    predicted
        Prediction of each model; empty without a value.
    """

    candidate: CandidateInput
    value: float
    violation: float = 0.0
    why: str = ""
    predicted: tuple[PredictedExperiment, ...] = field(default=(), repr=False)

    @property
    def ok(self) -> bool:
        return bool(np.isfinite(self.value))

    @property
    def evidence(self) -> FloatArray:
        """The expected evidence for each model against each rival, from derivatives."""
        return evidence_table(self.predicted)


@dataclass(frozen=True)
class CandidateScorer:
    """Simulates candidates and computes their values.

    Attributes
    ----------
    models, criterion, parameters
        See `DesignCriterion.value`.
    queue
        Queue of the simulations.
    """

    models: Sequence[FittedCandidate]
    criterion: DesignCriterion
    parameters: tuple[str, ...]
    queue: DesignQueue

    def score(self, candidates: Sequence[CandidateInput]) -> list[ScoredCandidate]:
        """Return the value of each candidate, in their order."""
        if not candidates:
            return []
        return self.queue.use(
            [candidate.experiment for candidate in candidates],
            "simulating candidates",
            lambda runner: self._scored(runner, candidates),
        )

    def _scored(
        self, runner: Runner, candidates: Sequence[CandidateInput]
    ) -> list[ScoredCandidate]:
        limits = keeping_limits(runner, self.models, candidates)
        kept = [number for number, (violation, _) in enumerate(limits) if violation <= TOLERANCE]
        known = dict(zip(kept, predictions(runner, self.models, candidates, kept), strict=True))
        found = []
        for number, candidate in enumerate(candidates):
            predicted, (violation, why) = known.get(number, ""), limits[number]
            if isinstance(predicted, str):
                off = violation if violation > TOLERANCE else np.nan
                found.append(ScoredCandidate(candidate, np.nan, off, why or predicted))
                continue
            value = self.criterion.value(self.models, predicted, self.parameters)
            found.append(ScoredCandidate(candidate, value, predicted=predicted))
        return found


@dataclass(frozen=True)
class SearchedCandidates:
    """The candidates of a search.

    Attributes
    ----------
    scored
        All candidates, in their order.
    wanted
        Intended number of candidates, which is larger if the budget was used up.
    """

    scored: tuple[ScoredCandidate, ...]
    wanted: int


def search(
    scorer: CandidateScorer,
    maker: CandidateMaker,
    recorded: Sequence[CandidateInput],
    count: int,
    generator: np.random.Generator,
) -> SearchedCandidates:
    """Return candidates with their values.

    Half of them are random, in addition to the recorded inputs. Then the best are changed slightly
    in several rounds. This is an evolution strategy without recombination (H.-G. Beyer, H.-P.
    Schwefel, Nat. Comput. 1 (2002) 3-52, doi:10.1023/A:1015059928466).

    Parameters
    ----------
    scorer, maker
        Compute values of candidates, and make them.
    recorded
        Candidates with the inputs of earlier experiments.
    count
        Number of other candidates.
    generator
        The random generator.

    Raises
    ------
    ProblemError
        If no candidate satisfies its limits.
    BudgetError
        If the budget is used up before the first candidate has a value.
    """
    first = max(1, round(RANDOM_SHARE * count)) if maker.waveforms else 0
    drawn = [maker.draw(number, generator) for number in range(first)]
    found = scorer.score([*recorded, *drawn])
    wanted = len(found) + (count - first if maker.waveforms else 0)
    try:
        found += _shrunk(scorer, maker, found, first)
        if not any(each.ok for each in found):
            raise none_keeps_limits(found)
        left = count - first if maker.waveforms else 0
        for number, (size, parents) in enumerate(REFINEMENT_ROUNDS):
            most = left // (len(REFINEMENT_ROUNDS) - number)
            left -= most
            found += _improved(scorer, maker, found, (size, parents, most), generator)
    except BudgetError:
        if not any(each.ok for each in found):
            raise
    return SearchedCandidates(tuple(found), wanted)


def _improved(
    scorer: CandidateScorer,
    maker: CandidateMaker,
    found: Sequence[ScoredCandidate],
    how: tuple[float, int, int],
    generator: np.random.Generator,
) -> list[ScoredCandidate]:
    """Return changes of the best; `how` is their size, number of parents, and number of changes."""
    size, parents, most = how
    best = [each for each in ranked(found) if len(each.candidate.point)][:parents]
    if not best:
        return []
    return scorer.score(
        [
            maker.changed(best[i % len(best)].candidate, len(found) + i, size, generator)
            for i in range(most)
        ]
    )


def ranked(scored: Sequence[ScoredCandidate]) -> list[ScoredCandidate]:
    """Return the candidates with a value, the best first."""
    return sorted((each for each in scored if each.ok), key=lambda each: -each.value)


def _shrunk(
    scorer: CandidateScorer,
    maker: CandidateMaker,
    found: Sequence[ScoredCandidate],
    number: int,
) -> list[ScoredCandidate]:
    """Return candidates with smaller amplitudes, if too few satisfy the limits."""
    more: list[ScoredCandidate] = []
    large = [each.candidate for each in found if len(each.candidate.point)]
    for factor in SHRINKING if maker.limits.inputs else ():
        kept = sum(each.ok for each in (*found, *more) if len(each.candidate.point))
        if kept >= min(FEWEST_KEPT, len(large)):
            break
        more += scorer.score(
            [maker.shrunk(each, number + len(more) + i, factor) for i, each in enumerate(large)]
        )
    return more


def none_keeps_limits(found: Sequence[ScoredCandidate]) -> ProblemError:
    """Return an error that no input satisfies its limits, with the smallest violation."""
    if not found:
        return ProblemError(
            "waveforms: must leave an input to try, but no recorded input of the run respects the "
            "limits; name another family, or widen the limits"
        )
    leaving = [each for each in found if np.isfinite(each.violation)]
    if not leaving:
        return ProblemError(
            f"limits: must allow an input, but none of {len(found)} inputs could be used "
            f"({found[0].why}); narrow the limits of the inputs"
        )
    closest = min(leaving, key=lambda each: each.violation)
    name = closest.why.split()[0]
    scales = {bound.name: bound.scale for bound in closest.candidate.experiment.bounds}
    off = closest.violation * scales.get(name.rpartition(".")[0], 1.0)
    return ProblemError(
        f"limits: {name} must be respected, but none of {len(found)} inputs respects it with every "
        f"model, not even the smallest input: the closest input violates it by {off:.3g}; widen "
        "this limit, narrow the limits of the inputs, or choose other start values"
    )
