"""Which of the structures that a search has accepted is its answer.

A search accepts what fits and predicts better than the structure before it. Later effects are
wrong more often than first ones: they live of what the first ones leave. So the answer is looked
for once more among all that was accepted, by refits with each part of the data left out: a
structure takes the place of a plainer one where it predicts the parts better in all, and most of
them one by one; what is plainer takes the place of a structure that does not. A step that is
refused does not end the walk: a model may get worse before it gets right.

An effect whose strengths may all be zero, for all that the data say, is taken out again.

What is held out chooses nothing. It may veto an answer, and then the one before it is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.prediction import (
    LeaveOneOutPrediction,
    is_usable,
    predict,
)
from cluster_est.closed_loop.selection.refits import full_refit
from cluster_est.closed_loop.selection.rounds import (
    AcceptedStructure,
    ComparedStructure,
    RejectionReason,
    SelectionResult,
    SelectionRound,
    compared_structure,
)
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.result import Result
from cluster_est.uncertainty import Uncertainty, assess
from workers.messages import FloatArray

BETTER_PARTS = 2.0 / 3.0
"""Share of the parts left out that a structure must predict better, of those that tell any
difference. By definition: most of them."""
TOLD_APART = 0.01
"""Difference of a part's squares, over the mean of the parts, below which it tells none. By
definition: an effect that acts in few parts changes nothing in the others."""
STRENGTH_LEVEL = 0.05
"""p-value up to which strengths differ from zero, as an interval of 95 % says it of a single one.
By definition."""


def answers(fitter: Fitter, grown: SelectionResult) -> list[SelectionResult]:
    """Return the answer of a search, and those that it took the place of, the last one first.

    If the declared model predicts best, it is the only one.
    """
    without = grown.settings.without
    ends = [grown] if LoopPart.ANSWER in without else best_ancestors(grown)
    if LoopPart.STRENGTHS in without:
        return ends
    return [without_undetermined(fitter, each) for each in ends]


def best_ancestors(found: SelectionResult) -> list[SelectionResult]:
    """Return a search as it would have ended at what predicts best, then at what it replaced."""
    chain = [0]
    for number in range(1, len(found.accepted)):
        if _replaces(found.accepted[number], found.accepted[chain[-1]]):
            chain.append(number)
    return [ending_at(found, number) for number in reversed(chain[1:] or chain)]


def ending_at(found: SelectionResult, number: int) -> SelectionResult:
    """Return what a search had found when it accepted a structure; 0 is the declared model.

    What was accepted later did not predict better what was left out.
    """
    then, steps = found.accepted[number], found.steps[: number + 1]
    if number < len(found.accepted) - 1:
        steps = (*steps[:-1], replace(steps[-1], why=RejectionReason.REFITS))
    return replace(
        found,
        path=tuple(_not_the_answer(row, found, number) for row in found.path),
        current=then.model,
        prediction=then.prediction,
        rivals=then.rivals,
        steps=steps,
    )


def _not_the_answer(
    row: ComparedStructure, found: SelectionResult, number: int
) -> ComparedStructure:
    """The row of a structure, which is no longer accepted if it came after the answer."""
    later = [[c.label for c in each.model.added] for each in found.accepted[number + 1 :]]
    if not row.accepted or list(row.effects) not in later:
        return row
    return replace(row, accepted=False, stopped_by=LoopPart.ANSWER)


def _replaces(later: AcceptedStructure, earlier: AcceptedStructure) -> bool:
    """Return whether a structure takes the place of an earlier one; the plainer wins a tie."""
    if _complexity(later.model) > _complexity(earlier.model):
        return predicts_better(later.prediction, earlier.prediction)
    return not predicts_better(earlier.prediction, later.prediction)


def predicts_better(one: LeaveOneOutPrediction, other: LeaveOneOutPrediction) -> bool:
    """Return whether parts that were left out are predicted better: in all, and most of them."""
    if one.total >= other.total:
        return False
    change = one.squares - other.squares
    told = np.abs(change) > TOLD_APART * max(one.total, other.total) / len(change)
    return bool(np.mean(change[told] < 0.0) >= BETTER_PARTS) if told.any() else False


def _complexity(fitted: FittedModel) -> tuple[int, int]:
    return len(fitted.added), fitted.space.size


def without_undetermined(fitter: Fitter, found: SelectionResult) -> SelectionResult:
    """Take out effects whose strengths may all be zero, the least determined one first."""
    while found.current.added:
        current = found.current
        solution = Solution(current.x, current.sse, Ending.CONVERGED, jacobian=current.jacobian)
        known = assess(current.space, solution)
        p = [strength_p(each, current.space, current.x, known) for each in current.added]
        worst = int(np.argmax(p))
        if p[worst] <= STRENGTH_LEVEL:
            break
        found = without_effects(fitter, found, [worst], LoopPart.STRENGTHS)
    return found


def undetermined_sentence(model: FittedModel, fit: Result) -> str:
    """Return what the last fit of a model says against the strengths of an effect; "" for nothing.

    Its intervals are those that are reported.
    """
    if fit.uncertainty is None or fit.solution.x.shape != model.x.shape:
        return ""
    for added in model.added:
        if strength_p(added, model.space, fit.solution.x, fit.uncertainty) > STRENGTH_LEVEL:
            return f"by the last fit the strength of {added.label} may be zero"
    return ""


def strength_p(
    added: EffectCandidate, space: SearchSpace, x: FloatArray, known: Uncertainty
) -> float:
    """Return the p-value of the strengths of an effect, tested jointly against zero.

    With k strengths a and their covariance C, of which the noise is known with n degrees of
    freedom, a' C^-1 a / k follows F(k, n) where all are zero: G. A. F. Seber, C. J. Wild, Nonlinear
    Regression (1989), doi:10.1002/0471725315, section 5.3. For one strength it is the test that its
    confidence interval makes.

    Parameters
    ----------
    space, x
        The unknowns of a model with the effect, and where they stand.
    known
        Their uncertainty.

    Returns
    -------
    float
        1 where the data do not determine one of them; 0 where there is none, or each is at a bound
        that is not zero.
    """
    labels = [unknown.label for unknown in space.unknowns]
    names = [f"{added.effect.name}.{strength}" for strength in added.strengths]
    places = [labels.index(name) for name in names if name in labels]
    free = [i for i in places if not known.intervals[i].at_bound or x[i] == 0.0]
    if not free:
        return 0.0
    errors = np.array([known.intervals[i].std_error for i in free])
    shared = [known.shared.index(labels[i]) if labels[i] in known.shared else -1 for i in free]
    if not (np.isfinite(errors).all() and (errors > 0.0).all() and min(shared) >= 0):
        return 1.0
    scores = x[free] / errors
    correlations = known.correlations[np.ix_(shared, shared)]
    if not np.isfinite(correlations).all():
        return 1.0
    statistic = float(scores @ np.linalg.pinv(correlations, hermitian=True) @ scores) / len(free)
    return float(fdtrc(len(free), known.basis_degrees, statistic))


def without_effects(
    fitter: Fitter,
    found: SelectionResult,
    positions: Sequence[int],
    part: LoopPart,
) -> SelectionResult:
    """Take effects out of a result, and refit what stays.

    Where the other effects cannot be simulated without them, or run away, nothing stays.

    Parameters
    ----------
    positions
        Of the effects, among those that were added.
    part
        The part of the search that takes them out.
    """
    start = found.current.start
    for position in sorted(positions, reverse=True):
        start = start.minus(position)
    kept, prediction, screening = found.base, found.base_prediction, found.steps[0].screening
    gone = {found.current.added[position].label for position in positions}
    path = tuple(
        replace(row, accepted=False, stopped_by=part)
        if row.accepted and gone & {*row.effects}
        else row
        for row in found.path
    )
    if start.added:
        (refitted,) = fitter.fit(LoopStage.DROP, [start], full_refit(fitter))
        if refitted is not None and is_usable(fitter, refitted, found.base):
            number, floor = len(found.steps) + 1, fitter.noise_floor(found.noise)
            kept, prediction = refitted, predict(fitter, refitted)
            screening = screen(fitter, found.settings, refitted, number)
            row = compared_structure(fitter.records, found.base, refitted, floor, number, part)
            path = (*path, row)
    seen = SelectionRound(screening, (), WHY_TAKEN_OUT[part])
    rivals = {name: own for name, own in found.rivals.items() if name in kept.structure}
    return replace(
        found,
        current=kept,
        prediction=prediction,
        rivals=rivals,
        steps=(*found.steps, seen),
        path=path,
    )


WHY_TAKEN_OUT = {
    LoopPart.STRENGTHS: RejectionReason.STRENGTHS,
    LoopPart.FUNCTIONS_OF_TIME: RejectionReason.FUNCTIONS_OF_TIME,
}
