"""Moves: one effect more, two at once, others in the place of earlier ones, one less.

The best pairs of directions are found by linear algebra alone: for two unit directions b, c with
g = b'c and the residual's shares x = b'r, y = c'r, both together carry
(x^2 + y^2 - 2 g x y) / (1 - g^2) of r'r.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.screening.screen import CandidateRanking, screen
from cluster_est.closed_loop.selection.gates import admissible, claimable_sse, useful_sse
from cluster_est.closed_loop.selection.linear_model import (
    UsefulFit,
    is_proportional,
    joint_step,
    may_start_useful,
    shares_left,
    values_at,
)
from cluster_est.closed_loop.selection.neighbours import refit_same_argument, refit_switch_widths
from cluster_est.closed_loop.selection.prediction import can_be_linearised, is_usable, predict
from cluster_est.closed_loop.selection.refits import (
    RefittedCandidate,
    Rivals,
    ending_with,
    full_refit,
    plainest,
    refit,
    refit_briefly,
    rivals_of,
    successive_halving,
)
from cluster_est.closed_loop.selection.rounds import (
    RejectionReason,
    RoundStart,
    SelectionResult,
    SelectionRound,
    compared_structure,
)
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.thresholds import PairThresholds
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from workers.messages import FloatArray


def grow(
    workbench: LoopWorkbench,
    begun: RoundStart,
    parents: Sequence[FittedModel],
    known: Collection[frozenset[str]] = (),
) -> list[RefittedCandidate]:
    """Refit structures with one effect more than each parent has; the best first.

    A structure that several parents lead to is refitted from the first of them alone, and one that
    is known already not at all. What cannot come to be of any use is refitted no further: from the
    second parent on it must come near the best structure so far.
    """
    found: dict[frozenset[str], RefittedCandidate] = {}
    large = _leaves_much(workbench, begun)
    for parent in parents:
        accepted = parent is begun.model
        if not accepted and not can_be_linearised(workbench, parent):
            continue
        ranking = begun.screening.ranking if accepted else begun.visited.ranking(workbench, parent)
        best = min((c.criterion for c in found.values()), default=np.inf)
        useful = UsefulFit(
            best + workbench.thresholds.refinement.alternative,
            useful_sse(workbench, begun, len(parent.added) + 1),
        )
        earlier = begun.visited.grown_from(parent)
        contenders = refit(
            workbench,
            parent,
            ranking,
            begun.floor,
            wide=accepted,
            further=accepted and large,
            known={*known, *found},
            done={c.fitted.structure for c in earlier},
            useful=useful,
        )
        contenders = sorted([*contenders, *earlier], key=lambda c: c.criterion)
        contenders += refit_same_argument(workbench, parent, ranking, contenders)
        contenders = refit_switch_widths(workbench, contenders, useful.criterion)
        begun.visited.add(parent, contenders)
        for contender in contenders:
            found.setdefault(contender.fitted.structure, contender)
    return sorted(found.values(), key=lambda c: c.criterion)


def _leaves_much(workbench: LoopWorkbench, begun: RoundStart) -> bool:
    """Return whether what is missing is still large: the score of a small effect says enough."""
    closed = begun.base.sse - begun.model.sse
    share = workbench.thresholds.refinement.closes
    return closed < share * (begun.base.sse - begun.floor)


def best_distinct(
    workbench: LoopWorkbench,
    base: FittedModel,
    contenders: Sequence[RefittedCandidate],
    first: FittedModel | None = None,
) -> tuple[FittedModel, ...]:
    """The beam: the best structures whose predictions differ, refitted to convergence.

    Structures that predict the same leave the same residual, and so lead to the same next effects:
    a second name for a structure that is in the beam already would be a place lost.

    Parameters
    ----------
    base
        The declared model, fitted: predictions are compared by how they differ from its own.
    contenders
        The structures to choose from.
    first
        A structure that has its place in any case.
    """
    width = workbench.settings.beam
    kept = [] if first is None else [first]
    changes = [_direction(base, fitted) for fitted in kept]
    for contender in sorted(contenders, key=lambda c: c.criterion):
        if len(kept) >= width:
            break
        change = _direction(base, contender.fitted)
        alike = [float(np.add.reduce(change * other)) for other in changes]
        if (
            contender.candidate.form.free
            or max(alike, default=0.0) > workbench.thresholds.beam.alike
        ):
            continue
        kept.append(contender.fitted)
        changes.append(change)
    rough = {id(c.fitted) for c in contenders if not c.full}
    asked = [fitted.start for fitted in kept if id(fitted) in rough]
    finished = iter(workbench.fit(LoopStage.REFITS, asked, full_refit(workbench)))
    return tuple((next(finished) or f) if id(f) in rough else f for f in kept)


def _direction(base: FittedModel, fitted: FittedModel) -> FloatArray:
    """The change of the residuals from the declared model's, of length 1."""
    change = fitted.residuals - base.residuals
    return change / max(float(np.sqrt(np.add.reduce(change**2))), 1e-300)


def refit_pairs(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    floor: float,
    useful: UsefulFit,
) -> list[RefittedCandidate]:
    """Refit the best pairs; the best first. A contender's last two effects are the pair.

    Those that the linear model does not let hope to be useful are left out.
    """
    found = best_pairs(ranking, workbench.thresholds.pairs)
    asked = [_start_of_pair(workbench, current, ranking, pair, useful) for pair in found]
    fits = refit_briefly(workbench, [start for start in asked if start is not None])
    return successive_halving(workbench, current, floor, fits, useful)


def best_pairs(
    ranking: CandidateRanking, thresholds: PairThresholds | None = None
) -> list[tuple[int, int]]:
    """Pairs of trials of different candidates by the share of the residual that they carry."""
    thresholds = thresholds or PairThresholds()
    scores = ranking.plain
    usable = [
        i for i in np.argsort(-scores.statistics, kind="stable").tolist()
        if scores.df[i] == 1 and not ranking.trials[i].candidate.form.free
    ][: thresholds.leaders]  # fmt: skip
    if len(usable) < 2:
        return []
    first = scores.offsets[usable]
    basis, shares = scores.bases[:, first], scores.coordinates[first]
    gram = basis.T @ basis
    a, b = np.triu_indices(len(usable), 1)
    g = gram[a, b]
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = (shares[a] ** 2 + shares[b] ** 2 - 2.0 * g * shares[a] * shares[b]) / (1 - g**2)
    carried[np.abs(g) > thresholds.alike] = 0.0
    found: list[tuple[int, int]] = []
    seen: set[frozenset[str]] = set()
    for k in np.argsort(-carried, kind="stable").tolist():
        i, j = usable[a[k]], usable[b[k]]
        names = frozenset(ranking.trials[m].candidate.effect.name for m in (i, j))
        if len(names) < 2 or names in seen or carried[k] <= 0.0:
            continue
        seen.add(names)
        found.append((i, j))
        if len(found) >= thresholds.fitted:
            break
    return found


def _start_of_pair(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    pair: tuple[int, int],
    useful: UsefulFit,
) -> FitStart | None:
    """Both effects, with the strengths of the joint linear step; None if of no use."""
    _, strengths, after = joint_step(current, ranking, pair)
    start = current.start
    for m, own in zip(pair, strengths, strict=True):
        trial = ranking.trials[m]
        values = values_at(trial, own, workbench.thresholds.refinement)
        start = start.plus(trial.candidate, values)
    if all(is_proportional(ranking.trials[m]) for m in pair):
        added = workbench.space(start).size - len(current.x)
        left = shares_left(ranking.records, current.residuals[ranking.rows], after)
        if not may_start_useful(workbench, current, left, added, useful):
            return None
    return start


def revise(
    workbench: LoopWorkbench,
    begun: RoundStart,
    grown: FittedModel,
    rivals: Rivals,
) -> tuple[FittedModel, Rivals]:
    """Replace earlier effects that others are better than now, and drop those not needed.

    Parameters
    ----------
    begun
        The round that it was chosen in.
    grown
        The structure, fitted.
    rivals
        Of its effects.

    Returns
    -------
    FittedModel
        The structure that is left.
    Rivals
        Of its effects; those of others may be among them.
    """
    thresholds = workbench.thresholds.revision
    saved = thresholds.drop_price * float(np.log(begun.screening.count))  # by an effect less
    for sweep in range(thresholds.sweeps):
        before = grown
        for position in range(len(grown.added) - (sweep == 0)):
            found = _instead(workbench, begun, grown, (position,), -thresholds.swap)
            if found is not None:
                # in its old place, so that the other positions still mean the same effects
                grown, rivals = found[0].fitted.moved(position), {**rivals, **found[1]}
        if grown is before:
            break
    if workbench.settings.beam > 1:
        grown, rivals = _merged(workbench, begun, grown, saved, rivals)
    return _without_needless(workbench, grown, saved), rivals


def _merged(
    workbench: LoopWorkbench, begun: RoundStart, grown: FittedModel, saved: float, rivals: Rivals
) -> tuple[FittedModel, Rivals]:
    """The structure with one effect in the place of two, as long as that pays."""
    for pair in combinations(range(len(grown.added)), 2):
        found = _instead(workbench, begun, grown, pair, saved)
        if found is not None:
            return _merged(workbench, begun, found[0].fitted, saved, {**rivals, **found[1]})
    return grown, rivals


def _without_needless(workbench: LoopWorkbench, grown: FittedModel, saved: float) -> FittedModel:
    """The structure without the effects that do not pay for themselves; one is left at least."""
    for position in reversed(range(len(grown.added))):
        if len(grown.added) < 2:
            break
        (rest,) = workbench.fit(
            LoopStage.DROP, [grown.start.minus(position)], full_refit(workbench)
        )
        if rest is not None and (
            rest.criterion(workbench.records) < grown.criterion(workbench.records) + saved
        ):
            grown = rest
    return grown


def _instead(
    workbench: LoopWorkbench,
    begun: RoundStart,
    grown: FittedModel,
    positions: tuple[int, ...],
    rise: float,
) -> tuple[RefittedCandidate, Rivals] | None:
    """The best effect in the place of some, with its rivals.

    Other functions of the argument of the one that is replaced start from where that one stands:
    without it the model may be far from there.

    None if the criterion would rise by more than what it may, or it cannot be gone on from, or
    nothing can be added to it and too little is closed for a claim.
    """
    start = grown.start
    for position in reversed(positions):
        start = start.minus(position)
    (rest,) = workbench.fit(LoopStage.SWAP, [start], full_refit(workbench))
    if rest is None or not can_be_linearised(workbench, rest):
        return None
    thresholds = workbench.thresholds.refinement
    most = grown.criterion(workbench.records) + rise
    claimable = claimable_sse(workbench, begun, len(rest.added) + 1)
    useful = UsefulFit(most + thresholds.alternative, claimable)
    ranking = begun.visited.ranking(workbench, rest)
    earlier = begun.visited.grown_from(rest)
    refitted = refit(
        workbench,
        rest,
        ranking,
        begun.floor,
        wide=False,
        further=False,
        done={c.fitted.structure for c in earlier},
        useful=useful,
    )
    refitted += earlier
    if len(positions) == 1:
        own = RefittedCandidate(grown, grown.criterion(workbench.records), True)
        there = ending_with(own, grown.added[positions[0]].effect.name)
        refitted += refit_same_argument(workbench, rest, ranking, [there])
    refitted = refit_switch_widths(workbench, refitted, useful.criterion)
    begun.visited.add(rest, refitted)
    contenders = admissible(workbench, rest, refitted)
    if not contenders or contenders[0].criterion >= most:
        return None
    won = plainest(contenders, thresholds)
    name = won.candidate.effect.name
    if not is_usable(workbench, won.fitted, rest):
        return None
    return won, {name: rivals_of(won, contenders, thresholds)[name]}


def functions_of_time(found: SelectionResult) -> tuple[EffectCandidate, ...]:
    """Return the effects that were added and are functions of time alone."""
    return tuple(c for c in found.current.added if c.form.of_time_alone)


def without_functions_of_time(workbench: LoopWorkbench, found: SelectionResult) -> SelectionResult:
    """Take the functions of time out of a result, and refit what stays.

    Where the other effects cannot be simulated without them, or run away, nothing stays.
    """
    start = found.current.start
    for position in reversed(range(len(found.current.added))):
        if found.current.added[position].form.of_time_alone:
            start = start.minus(position)
    kept, prediction, screening = found.base, found.base_prediction, found.steps[0].screening
    gone = {c.label for c in functions_of_time(found)}
    path = tuple(
        replace(row, accepted=row.accepted and not gone & {*row.effects}) for row in found.path
    )
    if start.added:
        (refitted,) = workbench.fit(LoopStage.DROP, [start], full_refit(workbench))
        if refitted is not None and is_usable(workbench, refitted, found.base):
            number, floor = len(found.steps) + 1, workbench.noise_floor(found.noise)
            kept, prediction = refitted, predict(workbench, refitted)
            screening = screen(workbench, refitted, number)
            path += (compared_structure(workbench, found.base, refitted, floor, number),)
    seen = SelectionRound(screening, (), RejectionReason.FUNCTIONS_OF_TIME)
    rivals = {name: own for name, own in found.rivals.items() if name in kept.structure}
    return replace(
        found,
        current=kept,
        prediction=prediction,
        rivals=rivals,
        steps=(*found.steps, seen),
        path=path,
    )
