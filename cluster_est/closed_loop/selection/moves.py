"""The moves of a search: each proposes structures, from the current one, its ranking and the data.

`MOVES` extend a structure, in the order in which they are tried: one more effect, two more effects,
one more effect without an earlier one, a free curve, a free filter. After a structure has passed
the gates, `drop` removes effects that no longer pay, and `release_widths` estimates the widths of
its switches. `LoopPart` has the names of the moves, with which a setting leaves them out. All moves
prune their candidates by the same rules (`refits.py`, `linear_model.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.screen import CandidateRanking, place_of, rank
from cluster_est.closed_loop.selection.acceptance import can_be_linearised
from cluster_est.closed_loop.selection.argument_functions import (
    criterion_falls,
    free_curve,
    free_dynamics,
    refit_siblings,
    with_filters,
)
from cluster_est.closed_loop.selection.gates import GATES, SELECTION, beyond_coloured_noise
from cluster_est.closed_loop.selection.linear_model import (
    REFINEMENT,
    PruningBound,
    can_reach_with,
    first_steps,
    gauss_newton_step,
    shares_left,
)
from cluster_est.closed_loop.selection.refits import (
    ALIKE,
    SHORT,
    Growth,
    RefittedCandidate,
    best_first,
    ending_with,
    full_refit,
    refit,
    refit_fully,
    refit_pairs,
)
from cluster_est.closed_loop.selection.rounds import (
    VERDICT,
    RoundEnd,
    RoundStart,
    can_be_claimed,
    leaves_more_than_noise,
    may_leave_noise,
    useful_sse,
)
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.problem.parameter import Parameter
from workers.effects.kinds import GridScale
from workers.messages import FloatArray

WIDTHS = (0.3, 2.5, 8.0, 25.0)
"""Widths of a switch that are tried, relative to the held width."""

BEAM = 4
"""Largest number of single effects that are extended to pairs."""

DROP_PRICE = 2.0
"""Largest rise of the criterion for which an effect is dropped, as a multiple of the logarithm of
the number of candidates. Theory: a Bonferroni correction; the criterion counts it twice."""


@dataclass(frozen=True)
class Move:
    """A way to extend or change a structure; it is tried only where the residual is significant.

    Attributes
    ----------
    part
        Its name.
    propose
        A function that refits structures, given the best result so far; returns the best first.
    is_worth
        Whether the move is tried, given the result of the moves before it.
    preferred
        Selects one of two results of a round: the best so far, or the result of this move.
    widened
        The start of the round, with additional candidates that only this move tries.
    """

    part: LoopPart
    propose: Callable[[Fitter, RoundStart, RoundEnd], list[RefittedCandidate]]
    is_worth: Callable[[RoundStart, RoundEnd], bool]
    preferred: Callable[[RoundStart, RoundEnd, RoundEnd], RoundEnd]
    widened: Callable[[Fitter, RoundStart], RoundStart] = lambda _, begun: begun


def add(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose structures with one more effect."""
    del best
    return _grown(fitter, begun, begun.model, begun.screening.ranking)


def add_two(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose structures with two more effects: from pairs of directions, and from single effects.

    For a pair of directions, only the first step of both effects is known, which hardly separates
    forms at the same place. So other forms at the places of the best pair are compared, each at
    the model with the other effect. If both effects are large, the second one shows only at the
    model with the first. So if no single effect passes, the best ones are extended: a beam search
    of width `BEAM` (B. T. Lowerre, The HARPY Speech Recognition System, Carnegie Mellon University,
    1976).
    """
    bound = begun.bound(sse=useful_sse(begun, len(begun.model.added) + 2))
    pairs = refit_pairs(fitter, begun.model, begun.screening.ranking, begun.floor, bound)
    large = leaves_more_than_noise(begun.model, begun.floor)
    others = _other_forms(fitter, begun, pairs[0], bound) if large and pairs else []
    found: dict[frozenset[str], RefittedCandidate] = {}
    for pair in sorted((*pairs, *others), key=lambda c: c.criterion):
        found.setdefault(pair.fitted.structure, pair)
    grows = large and best.won is None and begun.has(LoopPart.BEAM)
    singles = _that_may_grow(fitter, begun, best) if grows else []
    for parent in distinct(fitter, begun, singles):
        if can_be_linearised(fitter, parent):
            ranking = rank(fitter, begun.settings, parent)
            most = min((c.criterion for c in found.values()), default=np.inf)
            for each in _grown(fitter, begun, parent, ranking, most):
                known = found.setdefault(each.fitted.structure, each)
                if each.criterion < known.criterion:
                    found[each.fitted.structure] = each
    return sorted(found.values(), key=lambda c: c.criterion)


def _other_forms(
    fitter: Fitter, begun: RoundStart, pair: RefittedCandidate, bound: PruningBound
) -> list[RefittedCandidate]:
    """Refit other forms at the places of a pair, compared at the model without the effect there.

    If an effect is large, that model is far from the data, and its linear model hardly separates
    forms. So each effect of the best pair is then compared with its siblings, from where this pair
    stands. Nothing is done if the pair explains too little for a claim; other forms would not
    change this.
    """
    if not begun.has(LoopPart.OTHER_FORMS) or not can_be_claimed(begun, pair.fitted):
        return []
    first = len(begun.model.added)
    found: list[RefittedCandidate] = []
    for position in (first, first + 1):
        rest = _without(fitter, pair.fitted, position)
        if rest is not None:
            found += _forms_in_place(fitter, begun, pair.fitted, position, rest, bound)
    best = min((pair, *found), key=lambda c: c.criterion)
    for position in (first, first + 1):
        rest = _without(fitter, best.fitted, position)
        if rest is not None:
            own = ending_with(best, best.fitted.added[position].effect.name)
            found += refit_siblings(fitter, begun, rest, begun.screening.ranking, [own])
    return with_widths(fitter, begun, sorted((pair, *found), key=lambda c: c.criterion))


def _without(fitter: Fitter, model: FittedModel, position: int) -> FittedModel | None:
    """Refit a structure without one of its effects; None if it then cannot be linearised."""
    (rest,) = fitter.fit(LoopStage.REFITS, [model.start.minus(position)], full_refit(fitter))
    return rest if rest is not None and can_be_linearised(fitter, rest) else None


def _forms_in_place(
    fitter: Fitter,
    begun: RoundStart,
    model: FittedModel,
    position: int,
    rest: FittedModel,
    bound: PruningBound,
) -> list[RefittedCandidate]:
    """Refit the best other forms at the place of one effect, compared at the rest of the model."""
    ranking, place = rank(fitter, begun.settings, rest), place_of(model.added[position])
    trials = [trial.candidate for trial in ranking.trials]
    there = [
        i
        for i in ranking.leaders(ranking.plain, len(trials))
        if place_of(trials[i]) == place and trials[i].effect.name not in model.structure
    ]
    steps = first_steps(fitter, rest, ranking, there[: REFINEMENT.finalists], bound)
    grown = Growth(fitter, rest, begun.floor, bound).refit_steps(steps)
    return [replace(contender, move=LoopPart.OTHER_FORMS) for contender in grown]


def _grown(
    fitter: Fitter,
    begun: RoundStart,
    parent: FittedModel,
    ranking: CandidateRanking,
    most: float = np.inf,
) -> list[RefittedCandidate]:
    """Refit structures with one more effect than a parent; the best comes first, without repeats.

    A refit stops early if it can reach neither a criterion near `most` nor a useful improvement.
    """
    bound = begun.bound(most + REFINEMENT.alternative, useful_sse(begun, len(parent.added) + 1))
    found = refit(fitter, parent, ranking, begun.floor, begun.settings, bound)
    found += refit_siblings(fitter, begun, parent, ranking, found)
    best: dict[frozenset[str], RefittedCandidate] = {}
    for contender in sorted(found, key=lambda c: c.criterion):
        best.setdefault(contender.fitted.structure, contender)
    return with_widths(fitter, begun, list(best.values()))


def _that_may_grow(
    fitter: Fitter, begun: RoundStart, best: RoundEnd
) -> Sequence[RefittedCandidate]:
    """Return all single effects; if the best may be noise, only those that noise cannot explain."""
    first = best.seen.contenders[:1]
    if not first or beyond_coloured_noise(fitter, begun, first):
        return best.compared
    return beyond_coloured_noise(fitter, begun, best.compared)


def distinct(
    fitter: Fitter, begun: RoundStart, contenders: Sequence[RefittedCandidate]
) -> list[FittedModel]:
    """Return the best structures with different predictions, refitted to convergence.

    Structures with the same predictions leave the same residual, and lead to the same next effects.
    A second one of them would waste a place in the beam.
    """
    kept: list[FittedModel] = []
    changes: list[FloatArray] = []
    for contender in sorted(contenders, key=lambda c: c.criterion):
        change = contender.fitted.residuals - begun.base.residuals
        change /= max(float(np.sqrt(np.add.reduce(change**2))), 1e-300)
        alike = max((float(np.add.reduce(change * other)) for other in changes), default=0.0)
        if contender.candidate.form.free or alike > ALIKE:
            continue
        kept.append(contender.fitted)
        changes.append(change)
        if len(kept) == BEAM:
            break
    done = {id(c.fitted) for c in contenders if c.full}
    rough = [fitted for fitted in kept if id(fitted) not in done]
    return [*(f for f in kept if id(f) in done), *refit_fully(fitter, rough)]


def _two_are_worth(begun: RoundStart, best: RoundEnd) -> bool:
    """Return whether to try two effects at once: not if a single one closes most of the gap."""
    done = best.won is not None and best.seen.closed >= VERDICT.most
    return _has_room_for_two(begun, best) and not done


def _has_room_for_two(begun: RoundStart, best: RoundEnd) -> bool:
    """Return whether two effects are allowed: not if the best one may be only coloured noise."""
    settings = begun.settings
    room = len(begun.model.added) + 2 <= settings.max_effects
    return settings.pairs and room and not (best.won is None and best.seen.coloured)


def _two_that_pay(begun: RoundStart, single: RoundEnd, double: RoundEnd) -> RoundEnd:
    """Return the end of the round with one more effect, or with two.

    Two must pay for the choice among so many pairs, and predict better than the single one by the
    rule by which the answer is chosen.
    """
    if double.won is None or double.prediction is None:
        return single
    if single.won is None or single.prediction is None:
        return double
    price = SELECTION.pair_price * np.log(begun.screening.count)
    pays = double.won.criterion + price <= single.won.criterion
    return double if pays and double.prediction.is_better_than(single.prediction) else single


def exclude(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose the best refused structure, without an effect that was accepted before.

    The earlier effect may have stood for something that the structure now describes better, and may
    spoil its predictions. This is the conditional exclusion of floating searches (P. Pudil,
    J. Novovicova, J. Kittler, Floating search methods in feature selection, Pattern Recognition
    Letters 15, 1119, 1994, DOI 10.1016/0167-8655(94)90127-9).
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
    return best_first(fitter.records, fits)


def own_if_it_won(begun: RoundStart, best: RoundEnd, own: RoundEnd) -> RoundEnd:
    """Select the result of a last-resort move if it has won; else the result before it.

    Such a move is tried only if nothing else has won. If it does not win, its proposals are
    discarded. This is safe because only `exclude` reads proposals, those of the moves before it.
    """
    del begun
    return best if own.won is None else own


def better_of_free(begun: RoundStart, curve: RoundEnd, own: RoundEnd) -> RoundEnd:
    """Select the better fit, a free curve or a free filter; the log always has the filters."""
    if own.won is not None and (curve.won is None or own.won.criterion < curve.won.criterion):
        return own
    return replace(curve, seen=replace(curve.seen, screening=begun.screening))


MOVES = (
    Move(LoopPart.ADD, add, lambda *_: True, lambda *ends: ends[-1]),
    Move(LoopPart.ADD_TWO, add_two, _two_are_worth, _two_that_pay),
    Move(
        LoopPart.EXCLUDE,
        exclude,
        lambda begun, best: best.won is None and bool(begun.model.added),
        own_if_it_won,
    ),
    Move(
        LoopPart.FREE_CURVE,
        free_curve,
        lambda begun, best: best.won is None and _has_room_for_two(begun, best),
        own_if_it_won,
    ),
    Move(
        LoopPart.FREE_DYNAMICS,
        free_dynamics,
        lambda _, best: best.won is None or best.won.candidate.form.free,
        better_of_free,
        with_filters,
    ),
)
"""The moves, in the order in which they are tried."""


def drop(fitter: Fitter, begun: RoundStart, model: FittedModel) -> FittedModel:
    """Drop the effects that do not pay for themselves, but keep at least one.

    If the remaining residual may be sensor noise, an effect must pay also under the assumption of
    coloured noise, because some slow function always follows slow noise. A structure that closes
    too little for a claim is not reduced: the next effect may change which effects it needs.
    """
    if not begun.has(LoopPart.DROP) or not can_be_claimed(begun, model):
        return model
    least = DROP_PRICE * float(np.log(begun.screening.count))
    for position in reversed(range(len(model.added))):
        if len(model.added) < 2:
            break
        start = model.start.minus(position)
        (rest,) = fitter.fit(LoopStage.DROP, [start], full_refit(fitter))
        if rest is None:
            continue
        white, coloured = criterion_falls(fitter.records, rest, model)
        fall = min(white, coloured) if may_leave_noise(begun, model) else white
        if fall < least:
            model = rest
    return model


def with_widths(
    fitter: Fitter, begun: RoundStart, contenders: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Return contenders; the best few have the widths of their switches refitted if that pays.

    Only contenders that may come near the best are refitted. Otherwise a form without a width would
    win over the right form with a wrong width.
    """
    most = min((c.criterion for c in contenders), default=np.inf) + REFINEMENT.alternative
    found = []
    for number, contender in enumerate(contenders):
        model = contender.fitted
        if number < REFINEMENT.finalists:
            model = release_widths(fitter, begun, model, most)
        if model is not contender.fitted:
            criterion = model.criterion(fitter.records)
            contender = RefittedCandidate(model, criterion, True, LoopPart.SWITCH_WIDTHS)
        found.append(contender)
    return sorted(found, key=lambda c: c.criterion)


def release_widths(
    fitter: Fitter, begun: RoundStart, model: FittedModel, most: float = np.inf
) -> FittedModel:
    """Refit a structure with the widths of its switches as unknowns, if that pays.

    Dry friction is a switch, and a simulation must give the switch a width. If the friction is
    small compared with the noise, the width matters little, so a search keeps it fixed. If the
    friction is large, the width shows in the data, and further effects would compensate for a wrong
    width. Some widths are simulated, and the linear model gives the step of the other unknowns for
    each. There is no refit if it cannot reach a criterion of `most`.
    """
    held = _held_widths(model)
    if not held or not begun.has(LoopPart.SWITCH_WIDTHS):
        return model
    parameters = tuple(held.get(p.name, p) for p in model.problem.parameters)
    start = replace(model.start, problem=replace(model.problem, parameters=parameters))
    space = fitter.space(start)
    points = np.tile(space.start, (len(WIDTHS), 1))
    for i, unknown in enumerate(space.unknowns):
        if unknown.label in held:  # its search coordinate is a logarithm
            points[:, i] = np.log(held[unknown.label].start) + np.log(WIDTHS)
    points = np.clip(points, space.lower, space.upper)
    (answers,) = fitter.evaluate(LoopStage.TRIALS, [(space, points)])
    found = []
    for point, at in zip(points, answers, strict=True):
        if at.ok:
            step = gauss_newton_step(model.jacobian, at.residuals)
            after = at.residuals + model.jacobian @ step
            found.append((float(np.add.reduce(after**2)), after, point))
    if not found:
        return model
    _, after, point = min(found, key=lambda each: each[0])
    left = shares_left(fitter.records, model.residuals, after)
    own = model.criterion(fitter.records)
    bound = PruningBound(criterion=min(own, most))
    if not can_reach_with(fitter.records, model, left, len(held), bound):
        return model
    best = replace(start, values={**start.values, **space.estimates(point)})
    (fit,) = fitter.fit(LoopStage.REFITS, [best], full_refit(fitter))
    return fit if fit is not None and fit.criterion(fitter.records) < own else model


def _held_widths(model: FittedModel) -> dict[str, Parameter]:
    """The parameters with held widths of switches, by name, freed between the ends of their grids.

    The scale of a width is the rms of its variable. The held reference value of a power law has
    another scale and stays held.
    """
    known = {p.name: p for p in model.problem.parameters if p.fixed}
    found = {}
    for candidate in model.added:
        columns = zip(*candidate.grid, strict=True)
        for c, values in zip(candidate.form.coefficients, columns, strict=True):
            held = known.get(f"{candidate.effect.name}.{c.name}")
            if held is not None and c.scale is GridScale.RMS_V:
                bounds = min(*values, held.start), held.upper  # rounding may put a start below
                found[held.name] = replace(held, fixed=False, bounds=bounds, scale="log")
    return found
