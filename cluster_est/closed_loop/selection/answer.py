"""Selects the answer of a search among the structures that it has accepted.

A search accepts a structure that fits and predicts better than the structure before it. Later
effects are wrong more often than the first ones, because they fit what the first ones leave. So
all accepted structures are compared once more, by refits with each part of the data left out. A
larger structure replaces a simpler one only if it predicts the parts better in total, and most of
them individually. A later, simpler structure replaces a larger one unless the larger one predicts
better. A refused structure does not end the comparison: a model may become worse before a later
effect makes it right.

A structure is not an answer if the data allow all strengths of one of its effects to be zero.
Without that effect it may be an answer. Effects with the same site and argument are one finding,
and are tested together.

Held-out data select nothing. They may veto an answer; then the answer before it is tested.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.acceptance import is_usable, predict
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

STRENGTH_LEVEL = 0.05
"""Largest p-value at which strengths count as different from zero; for a single strength, this is
the test by its 95 % interval. By definition."""


def answers(fitter: Fitter, grown: SelectionResult) -> list[SelectionResult]:
    """Return the answer of a search, and the answers that it replaced, the last one first.

    If the declared model predicts best, the list contains only that model.
    """
    without, accepted = grown.settings.without, grown.accepted
    if LoopPart.ANSWER in without:
        return [grown]
    tested = LoopPart.STRENGTHS not in without
    doubtful = {
        n
        for n, each in enumerate(accepted)
        if tested and least_determined(fitter, each.model) is not None
    }
    chain = best_ancestors(accepted, doubtful)
    best = chain[-1]
    ends = [ending_at(grown, number) for number in reversed(chain[1:] or chain)]
    better = [n for n in doubtful if _replaces(accepted[n], accepted[best])]
    if better:
        number = min(better, key=lambda n: accepted[n].prediction.total)
        kept = without_undetermined(fitter, ending_at(grown, number))
        now = AcceptedStructure(kept.current, kept.prediction, kept.rivals)
        if now.model.added and _replaces(now, accepted[best]):
            return [kept, *ends] if best else [kept]
        ends[0] = replace(ends[0], steps=_ended(ends[0].steps, RejectionReason.STRENGTHS))
    return ends


def best_ancestors(
    accepted: Sequence[AcceptedStructure], left_out: Collection[int] = ()
) -> list[int]:
    """Return the indices of the structures that replaced all structures before them, in order.

    The first one is the declared model, and the last one is the answer. Structures in `left_out`
    are skipped.
    """
    chain = [0]
    for number in range(1, len(accepted)):
        if number not in left_out and _replaces(accepted[number], accepted[chain[-1]]):
            chain.append(number)
    return chain


def ending_at(found: SelectionResult, number: int) -> SelectionResult:
    """Return the result of a search when it accepted a structure; 0 is the declared model.

    Structures that were accepted later did not predict the left-out parts better.
    """
    then, steps = found.accepted[number], found.steps
    steps = steps[: then.rounds + 1]
    if number < len(found.accepted) - 1:
        steps = _ended(steps, RejectionReason.REFITS)
    return replace(
        found,
        path=tuple(_not_the_answer(row, found, number) for row in found.path),
        current=then.model,
        prediction=then.prediction,
        rivals=then.rivals,
        steps=steps,
    )


def _ended(steps: tuple[SelectionRound, ...], why: RejectionReason) -> tuple[SelectionRound, ...]:
    return (*steps[:-1], replace(steps[-1], why=why))


def _not_the_answer(
    row: ComparedStructure, found: SelectionResult, number: int
) -> ComparedStructure:
    """Return a row of the search path; a structure after the answer is no longer accepted."""
    later = [[c.label for c in each.model.added] for each in found.accepted[number + 1 :]]
    if not row.accepted or list(row.effects) not in later:
        return row
    return replace(row, accepted=False, stopped_by=LoopPart.ANSWER)


def _replaces(later: AcceptedStructure, earlier: AcceptedStructure) -> bool:
    """Return whether a structure replaces an earlier one; if both are equal, the simpler wins."""
    if _complexity(later.model) > _complexity(earlier.model):
        return later.prediction.is_better_than(earlier.prediction)
    return not earlier.prediction.is_better_than(later.prediction)


def _complexity(fitted: FittedModel) -> tuple[int, int]:
    return len(fitted.added), fitted.space.size


def without_undetermined(fitter: Fitter, found: SelectionResult) -> SelectionResult:
    """Remove effects whose strengths may all be zero, the least determined effect first."""
    while (worst := least_determined(fitter, found.current)) is not None:
        found = without_effect(fitter, found, worst)
    return found


def least_determined(fitter: Fitter, model: FittedModel) -> int | None:
    """Return the position of the effect whose strengths are most likely zero; None if none is."""
    if not model.added:
        return None
    solution = Solution(model.x, model.sse, Ending.CONVERGED, jacobian=model.jacobian)
    known = assess(model.space, solution)
    given = model.space, model.x, known
    p = strength_p(model.added, *given)
    alone = [strength_p([each], *given)[0] for each in model.added]
    for worst in sorted(range(len(p)), key=lambda i: (-p[i], -alone[i])):
        if p[worst] <= STRENGTH_LEVEL:
            return None
        if p_without(fitter, model, worst, known.basis_degrees) > STRENGTH_LEVEL:
            return worst
    return None


def undetermined_sentence(
    model: FittedModel, fit: Result, without: Callable[[FittedModel, int, float], float]
) -> str:
    """Return a sentence if, by the last fit of a model, an effect's strengths may be zero; else "".

    The intervals are those in the report. `without` is `p_without` on a fitter of the model.
    """
    known = fit.uncertainty
    if known is None or fit.solution.x.shape != model.x.shape:
        return ""
    p = strength_p(model.added, model.space, fit.solution.x, known)
    doubtful = [
        candidate.label
        for i, (candidate, own) in enumerate(zip(model.added, p, strict=True))
        if own > STRENGTH_LEVEL and without(model, i, known.basis_degrees) > STRENGTH_LEVEL
    ]
    return (
        f"according to the last fit, the strength of {doubtful[0]} may be zero" if doubtful else ""
    )


def p_without(fitter: Fitter, model: FittedModel, position: int, degrees: float) -> float:
    """Return the p-value of an effect by a refit without it, instead of the linear model.

    For a stop or an overflow, the data show that it is stiff, but not how stiff. Near the fitted
    strength, the sum of squares hardly changes; far away, towards zero, it rises strongly. So the
    interval of the linear model contains zero although the effect exists. With k strengths, n
    degrees of freedom of the noise, and sums of squares S without the effect and s with it,
    n (S - s) / (k s) follows F(k, n) if the effect does not exist (see `strength_p`). If the model
    cannot be simulated without the effect, the p-value is 0.
    """
    start = model.start.minus(position)
    (refitted,) = fitter.fit(LoopStage.DROP, [start], full_refit(fitter))
    if refitted is None:
        return 0.0
    added = model.added[position]
    strengths = max(sum(added.counts(added.own_strengths)), 1)
    degrees = degrees if np.isfinite(degrees) else float(fitter.size - len(model.x))
    more = max(refitted.sse - model.sse, 0.0)
    return float(fdtrc(strengths, degrees, degrees * more / (strengths * model.sse)))


def strength_p(
    added: Sequence[EffectCandidate], space: SearchSpace, x: FloatArray, known: Uncertainty
) -> list[float]:
    """Return the p-value of each effect: a joint test of the strengths at its site and argument.

    With k strengths a and their covariance C, with n degrees of freedom of the noise,
    a' C^-1 a / k follows F(k, n) if all strengths are zero: G. A. F. Seber, C. J. Wild, Nonlinear
    Regression (1989), doi:10.1002/0471725315, section 5.3. For a single strength, this is the test
    by its confidence interval.

    Effects with the same site and argument share a test. The p-value is 1 if the data do not
    determine one of the strengths, or if one has a value per experiment: then a refit without the
    effect decides. It is 0 if there is no strength, or if each is at a bound other than zero.
    """
    labels = [unknown.label for unknown in space.unknowns]
    parameters = [unknown.parameter.name for unknown in space.unknowns]
    places: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for each in added:
        names = [f"{each.effect.name}.{strength}" for strength in each.strengths]
        own = [i for i, name in enumerate(parameters) if name in names]
        places.setdefault((str(each.site), each.effect.variables), []).extend(own)
    found = {place: _joint_p(own, labels, x, known) for place, own in places.items()}
    return [found[str(each.site), each.effect.variables] for each in added]


def _joint_p(
    strengths: Sequence[int], labels: Sequence[str], x: FloatArray, known: Uncertainty
) -> float:
    free = [i for i in strengths if not known.intervals[i].at_bound or x[i] == 0.0]
    if not free:
        return 0.0
    errors = np.array([known.intervals[i].std_error for i in free])
    shared = [known.shared.index(labels[i]) if labels[i] in known.shared else -1 for i in free]
    if not (np.isfinite(errors).all() and (errors > 0.0).all() and min(shared) >= 0):
        return 1.0
    correlations = known.correlations[np.ix_(shared, shared)]
    if not np.isfinite(correlations).all():
        return 1.0
    scores = x[free] / errors
    statistic = float(scores @ np.linalg.pinv(correlations, hermitian=True) @ scores) / len(free)
    return float(fdtrc(len(free), known.basis_degrees, statistic))


def without_effect(
    fitter: Fitter,
    found: SelectionResult,
    position: int,
) -> SelectionResult:
    """Remove an effect from a result, by its position, and refit the remaining structure.

    If the rest cannot be simulated or becomes unbounded, the result is the declared model.
    """
    start, part = found.current.start.minus(position), LoopPart.STRENGTHS
    kept, prediction, screening = found.base, found.base_prediction, found.steps[0].screening
    gone = found.current.added[position].label
    path = tuple(
        replace(row, accepted=False, stopped_by=part)
        if row.accepted and gone in row.effects
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
    seen = SelectionRound(screening, (), RejectionReason.STRENGTHS)
    rivals = {name: own for name, own in found.rivals.items() if name in kept.structure}
    return replace(
        found,
        current=kept,
        prediction=prediction,
        rivals=rivals,
        steps=(*found.steps, seen),
        path=path,
    )
