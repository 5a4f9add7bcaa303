"""The moves of a search: each proposes structures, from one, the ranking at it, and the data.

`MOVES` grow a structure, in the order in which they are tried: one effect more, two at once, one
more without an earlier one, a free curve. `REVISIONS` change one that has passed the gates: other
starts, others in the place of earlier effects, one for two, one less. `LoopPart` has their names,
by which a setting leaves them out. What they share is remembered and pruned in one place
(`refits.py`, `linear_model.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.selection.acceptance import admissible, can_be_linearised
from cluster_est.closed_loop.selection.free_curves import criterion_falls, free_curve
from cluster_est.closed_loop.selection.gates import GATES, SELECTION, may_go_on
from cluster_est.closed_loop.selection.linear_model import REFINEMENT
from cluster_est.closed_loop.selection.neighbours import refit_siblings, refit_switch_widths
from cluster_est.closed_loop.selection.refits import (
    ALIKE,
    SHORT,
    RefittedCandidate,
    Rivals,
    best_first,
    ending_with,
    full_refit,
    most_parsimonious,
    proposed_by,
    refit,
    refit_fully,
    refit_pairs,
    rivals_of,
)
from cluster_est.closed_loop.selection.rounds import (
    VERDICT,
    Revised,
    RoundEnd,
    RoundStart,
    can_be_claimed,
    claimable_sse,
    leaves_more_than_noise,
    may_leave_noise,
    useful_sse,
)
from cluster_est.closed_loop.selection.starts import refit_from_other_starts
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from workers.messages import FloatArray


@dataclass(frozen=True)
class RevisionThresholds:
    """Thresholds of the revision of effects that were added before.

    Attributes
    ----------
    sweeps
        Rounds through all effects at most. Benchmark.
    swap
        Fall of the criterion for which an earlier effect is replaced. Benchmark.
    drop_price
        Logarithms of the number of candidates by which the criterion may rise where an effect is
        dropped. Theory: a Bonferroni correction, twice the logarithm on the scale of the criterion.
    """

    sweeps: int = 2
    swap: float = 4.0
    drop_price: float = 2.0


REVISION = RevisionThresholds()


@dataclass(frozen=True)
class Move:
    """A way to grow a structure.

    Attributes
    ----------
    part
        Its name.
    propose
        Refit larger structures, given the best so far and what it was compared with; the best
        first.
    is_worth
        Whether it is tried after what the moves before it have come to.
    preferred
        The one of two ends of a round that is kept: the best so far, or that of its own proposals.
    """

    part: LoopPart
    propose: Callable[[Fitter, RoundStart, RoundEnd], list[RefittedCandidate]]
    is_worth: Callable[[RoundStart, RoundEnd], bool]
    preferred: Callable[[RoundStart, RoundEnd, RoundEnd], RoundEnd]


@dataclass(frozen=True)
class Revision:
    """A way to change a structure that has passed the gates; it may lead to the same one."""

    part: LoopPart
    revise: Callable[[Fitter, RoundStart, Revised], Revised]


def add(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose one effect more, for the accepted structure and for others that are as large."""
    del best
    return _grown(fitter, begun, _parents(fitter, begun), LoopPart.ADD)


def add_two(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose two effects more: from pairs of directions, and grown from single ones."""
    bound = begun.bound(sse=useful_sse(begun, len(begun.model.added) + 2))
    pairs = refit_pairs(fitter, begun.model, begun.screening.ranking, begun.floor, bound)
    found = {c.fitted.structure: c for c in pairs}
    if _grows_several(begun, begun.model):
        singles = best.compared if best.won is None else ()
        parents = best_distinct(fitter, begun, singles)
        for contender in _grown(fitter, begun, parents, LoopPart.ADD_TWO, known=tuple(found)):
            found.setdefault(contender.fitted.structure, contender)
    return sorted(found.values(), key=lambda c: c.criterion)


def _two_are_worth(begun: RoundStart, best: RoundEnd) -> bool:
    """Return whether two effects at once are worth a look: no single one does most of it."""
    done = best.won is not None and best.seen.closed >= VERDICT.most
    return _has_room_for_two(begun, best) and not done


def _has_room_for_two(begun: RoundStart, best: RoundEnd) -> bool:
    """Return whether more than one effect may be tried; two follow a disturbance the better."""
    settings = begun.settings
    room = len(begun.model.added) + 2 <= settings.max_effects
    return settings.pairs and room and not (best.won is None and best.seen.coloured)


def _two_that_pay(begun: RoundStart, single: RoundEnd, double: RoundEnd) -> RoundEnd:
    """One effect more or two, which must pay for the choice among so many pairs."""
    if double.won is None:
        return single
    price = SELECTION.pair_price * np.log(begun.screening.count)
    if single.won is not None and double.won.criterion + price > single.won.criterion:
        return single
    return double


def exclude(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose the best structure that was refused, without an effect that was accepted before.

    That effect may have stood for what the structure now says better, and spoil its predictions:
    the conditional exclusion of floating searches (P. Pudil, J. Novovicova, J. Kittler, Floating
    search methods in feature selection, Pattern Recognition Letters 15, 1119, 1994, DOI
    10.1016/0167-8655(94)90127-9).
    """
    gates = {gate.part for gate in GATES}
    refused = [c for c in best.compared if best.stopped.get(c.fitted.structure) in gates]
    leading = min(refused, key=lambda c: c.criterion, default=None)
    if leading is None or not can_be_claimed(begun, leading.fitted):
        return []
    model = leading.fitted
    earlier = [i for i, own in enumerate(model.added) if own.effect.name in begun.model.structure]
    starts = [model.start.minus(i) for i in earlier]
    brief = [f for f in fitter.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    fits = refit_fully(fitter, [f for f in brief if can_be_claimed(begun, f)])
    return best_first(fitter.records, fits, LoopPart.EXCLUDE)


def _own_if_it_won(begun: RoundStart, best: RoundEnd, own: RoundEnd) -> RoundEnd:
    """What a move has come to itself, where it is tried because nothing else has won."""
    del begun
    return best if own.won is None else own


MOVES = (
    Move(LoopPart.ADD, add, lambda *_: True, lambda *ends: ends[-1]),
    Move(LoopPart.ADD_TWO, add_two, _two_are_worth, _two_that_pay),
    Move(
        LoopPart.EXCLUDE,
        exclude,
        lambda begun, best: best.won is None and bool(begun.model.added),
        _own_if_it_won,
    ),
    Move(
        LoopPart.FREE_CURVE,
        free_curve,
        lambda begun, best: best.won is None and _has_room_for_two(begun, best),
        _own_if_it_won,
    ),
)
"""In the order in which they are tried."""


def _parents(fitter: Fitter, begun: RoundStart) -> tuple[FittedModel, ...]:
    """The accepted structure, and where it leaves more than noise, others as large."""
    if not begun.beside or not _grows_several(begun, begun.model):
        return (begun.model,)
    size = len(begun.model.added)
    beside = [c for c in begun.beside if len(c.fitted.added) == size]
    return best_distinct(fitter, begun, beside, first=begun.model)


def _grows_several(begun: RoundStart, fitted: FittedModel) -> bool:
    """Return whether the search is a wide one, and has something left to look for."""
    several = begun.settings.beam > 1 and begun.has(LoopPart.BEAM)
    return several and leaves_more_than_noise(fitted, begun.floor)


def _grown(
    fitter: Fitter,
    begun: RoundStart,
    parents: Sequence[FittedModel],
    move: LoopPart,
    known: Collection[frozenset[str]] = (),
) -> list[RefittedCandidate]:
    """Refit structures with one effect more than each parent has; the best first.

    A structure that several parents lead to is refitted from the first of them alone, and one that
    is known already not at all. What cannot come to be of any use is refitted no further: from the
    second parent on it must come near the best structure so far.
    """
    found: dict[frozenset[str], RefittedCandidate] = {}
    large = _leaves_much(begun)
    for parent in parents:
        accepted = parent is begun.model
        if not accepted and not can_be_linearised(fitter, parent):
            continue
        ranking = begun.screening.ranking
        if not accepted:
            ranking = begun.cache.ranking(fitter, begun.settings, parent)
        best = min((c.criterion for c in found.values()), default=np.inf)
        bound = begun.bound(best + REFINEMENT.alternative, useful_sse(begun, len(parent.added) + 1))
        earlier = begun.cache.grown_from(parent)
        contenders = refit(
            fitter,
            parent,
            ranking,
            begun.floor,
            begun.settings,
            wide=accepted,
            further=accepted and large,
            known={*known, *found},
            done={c.fitted.structure for c in earlier},
            bound=bound,
        )
        contenders = proposed_by(move, contenders)
        contenders = sorted([*contenders, *earlier], key=lambda c: c.criterion)
        contenders += refit_siblings(fitter, begun, parent, ranking, contenders)
        contenders = refit_switch_widths(fitter, begun, contenders, bound.criterion)
        begun.cache.add(parent, contenders)
        for contender in contenders:
            found.setdefault(contender.fitted.structure, contender)
    return sorted(found.values(), key=lambda c: c.criterion)


def _leaves_much(begun: RoundStart) -> bool:
    """Return whether what is missing is still large: the score of a small effect says enough."""
    closed = begun.base.sse - begun.model.sse
    return closed < REFINEMENT.closes * (begun.base.sse - begun.floor)


def best_distinct(
    fitter: Fitter,
    begun: RoundStart,
    contenders: Sequence[RefittedCandidate],
    first: FittedModel | None = None,
) -> tuple[FittedModel, ...]:
    """The beam: the best structures whose predictions differ, refitted to convergence.

    Structures that predict the same leave the same residual, and so lead to the same next effects:
    a second name for a structure that is in the beam already would be a place lost.

    Parameters
    ----------
    begun
        The round: predictions are compared by how they differ from the declared model's.
    contenders
        The structures to choose from.
    first
        A structure that has its place in any case.
    """
    base = begun.base
    kept = [] if first is None else [first]
    changes = [_direction(base, fitted) for fitted in kept]
    for contender in sorted(contenders, key=lambda c: c.criterion):
        if len(kept) >= begun.settings.beam:
            break
        change = _direction(base, contender.fitted)
        alike = [float(np.add.reduce(change * other)) for other in changes]
        if contender.candidate.form.free or max(alike, default=0.0) > ALIKE:
            continue
        kept.append(contender.fitted)
        changes.append(change)
    rough = {id(c.fitted) for c in contenders if not c.full}
    asked = [fitted.start for fitted in kept if id(fitted) in rough]
    finished = iter(fitter.fit(LoopStage.REFITS, asked, full_refit(fitter)))
    return tuple((next(finished) or f) if id(f) in rough else f for f in kept)


def _direction(base: FittedModel, fitted: FittedModel) -> FloatArray:
    """The change of the residuals from the declared model's, of length 1."""
    change = fitted.residuals - base.residuals
    return change / max(float(np.sqrt(np.add.reduce(change**2))), 1e-300)


def restart(fitter: Fitter, begun: RoundStart, grown: Revised) -> Revised:
    """Refit from other starts, where the search is a wide one and more than noise is left."""
    if not _grows_several(begun, grown.model):
        return grown
    found = refit_from_other_starts(fitter, begun.base, grown.model)
    return grown if found is grown.model else replace(grown, model=found)


def replace_earlier(fitter: Fitter, begun: RoundStart, grown: Revised) -> Revised:
    """Replace earlier effects that others are better than now, also in coloured noise.

    Where more than white noise is left, the criterion sees differences that are none.
    """
    if len(grown.model.added) < 2:
        return grown
    for sweep in range(REVISION.sweeps):
        before = grown.model
        for position in range(len(grown.model.added) - (sweep == 0)):
            places, rise = (position,), -REVISION.swap
            found = _instead(fitter, begun, grown.model, places, rise, LoopPart.REPLACE)
            if found is None:
                continue
            if min(criterion_falls(fitter.records, grown.model, found[0].fitted)) > 0.0:
                # in its old place, so that the other positions still mean the same effects
                model = found[0].fitted.moved(position)
                grown = replace(grown, model=model, rivals={**grown.rivals, **found[1]})
        if grown.model is before:
            break
    return grown


def merge_two(fitter: Fitter, begun: RoundStart, grown: Revised) -> Revised:
    """Put one effect in the place of two, as long as that pays."""
    if begun.settings.beam < 2:
        return grown
    for pair in combinations(range(len(grown.model.added)), 2):
        rise = _saved(begun)
        found = _instead(fitter, begun, grown.model, pair, rise, LoopPart.MERGE_TWO)
        if found is not None:
            rivals = {**grown.rivals, **found[1]}
            return merge_two(fitter, begun, replace(grown, model=found[0].fitted, rivals=rivals))
    return grown


def drop(fitter: Fitter, begun: RoundStart, grown: Revised) -> Revised:
    """Drop the effects that do not pay for themselves; one is left at least.

    Where what is left may be the noise of sensors, they must also pay in noise as coloured as that:
    slow noise always has some slow function that follows it.
    """
    model, records = grown.model, fitter.records
    for position in reversed(range(len(model.added))):
        if len(model.added) < 2:
            break
        start = model.start.minus(position)
        (rest,) = fitter.fit(LoopStage.DROP, [start], full_refit(fitter))
        if rest is None:
            continue
        white, coloured = criterion_falls(records, rest, model)
        fall = min(white, coloured) if may_leave_noise(begun, model) else white
        if fall < _saved(begun):
            model = rest
    return grown if model is grown.model else replace(grown, model=model)


REVISIONS = (
    Revision(LoopPart.RESTARTS, restart),
    Revision(LoopPart.REPLACE, replace_earlier),
    Revision(LoopPart.MERGE_TWO, merge_two),
    Revision(LoopPart.DROP, drop),
)
"""In the order in which they are done."""


def revise(fitter: Fitter, begun: RoundStart, end: RoundEnd, rivals: Rivals) -> Revised:
    """Let all revisions change what has won a round.

    What closes too little for a claim is grown first: other starts and a revision cost as much as a
    round, and the next effect changes what they would find.

    Parameters
    ----------
    end
        Of the round; something has won.
    rivals
        Of the effects that were accepted before.

    Raises
    ------
    ValueError
        If nothing has won.
    """
    if end.won is None:
        raise ValueError("only a set that has won a round can be revised")
    found = rivals_of(end.won, end.seen.contenders)
    rivals = {**found, **rivals, **{name: own for name, own in found.items() if own[1]}}
    grown = Revised(end.won.fitted, rivals)
    if not can_be_claimed(begun, grown.model):
        return grown
    for revision in REVISIONS:
        if begun.has(revision.part):
            new = revision.revise(fitter, begun, grown)
            grown = new if new is grown else replace(new, move=revision.part)
    return grown


def _saved(begun: RoundStart) -> float:
    """By how much the criterion may rise for an effect less."""
    return REVISION.drop_price * float(np.log(begun.screening.count))


def _instead(
    fitter: Fitter,
    begun: RoundStart,
    grown: FittedModel,
    positions: tuple[int, ...],
    rise: float,
    move: LoopPart,
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
    (rest,) = fitter.fit(LoopStage.SWAP, [start], full_refit(fitter))
    if rest is None or not can_be_linearised(fitter, rest):
        return None
    most = grown.criterion(fitter.records) + rise
    claimable = claimable_sse(begun, len(rest.added) + 1)
    bound = begun.bound(most + REFINEMENT.alternative, claimable)
    ranking = begun.cache.ranking(fitter, begun.settings, rest)
    earlier = begun.cache.grown_from(rest)
    refitted = refit(
        fitter,
        rest,
        ranking,
        begun.floor,
        begun.settings,
        wide=False,
        further=False,
        done={c.fitted.structure for c in earlier},
        bound=bound,
    )
    refitted = [*proposed_by(move, refitted), *earlier]
    if len(positions) == 1:
        own = RefittedCandidate(grown, grown.criterion(fitter.records), True)
        there = ending_with(own, grown.added[positions[0]].effect.name)
        refitted += refit_siblings(fitter, begun, rest, ranking, [there])
    refitted = refit_switch_widths(fitter, begun, refitted, bound.criterion)
    begun.cache.add(rest, refitted)
    waves = begun.has(LoopPart.WAVES)
    contenders = admissible(fitter, rest, refitted) if waves else refitted
    if not contenders or contenders[0].criterion >= most:
        return None
    won = most_parsimonious(contenders)
    name = won.candidate.effect.name
    if not may_go_on(fitter, begun, won.fitted, rest):
        return None
    return won, {name: rivals_of(won, contenders)[name]}
