"""The moves of a search: each proposes structures, from one, the ranking at it, and the data.

`MOVES` grow a structure, in the order in which they are tried: one effect more, two at once, one
more without an earlier one, a free curve, a free filter. Of a structure that has passed the gates,
`drop` takes out what no longer pays, and `release_widths` estimates how wide its switches are.
`LoopPart` has their names, by which a setting leaves them out. What they share is pruned in one
place (`refits.py`, `linear_model.py`).
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
"""Widths of a switch that are tried, over the held one."""

BEAM = 4
"""Single effects that are grown to pairs at most."""

DROP_PRICE = 2.0
"""Logarithms of the number of candidates by which the criterion may rise where an effect is
dropped. Theory: a Bonferroni correction, twice the logarithm on the scale of the criterion."""


@dataclass(frozen=True)
class Move:
    """A way to grow or change a structure. It is tried where something is significant at it.

    Attributes
    ----------
    part
        Its name.
    propose
        Refit structures, given the best so far and what it was compared with; the best first.
    is_worth
        Whether it is tried after what the moves before it have come to.
    preferred
        The one of two ends of a round that is kept: the best so far, or that of its own proposals.
    widened
        The start of the round, with the candidates that it alone looks at.
    """

    part: LoopPart
    propose: Callable[[Fitter, RoundStart, RoundEnd], list[RefittedCandidate]]
    is_worth: Callable[[RoundStart, RoundEnd], bool]
    preferred: Callable[[RoundStart, RoundEnd, RoundEnd], RoundEnd]
    widened: Callable[[Fitter, RoundStart], RoundStart] = lambda _, begun: begun


def add(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose one effect more."""
    del best
    return _grown(fitter, begun, begun.model, begun.screening.ranking)


def add_two(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose two effects more: from pairs of directions, and grown from single ones.

    A pair of directions is the first step of both, which hardly tells forms at one place apart. So
    the forms at the places of the best pair are compared again, each beside the other. Where each
    effect is large, the second one is seen only at the model with the first. So where no single one
    passes, the best are grown: a beam search of width `BEAM` (B. T. Lowerre, The HARPY Speech
    Recognition System, Carnegie Mellon University, 1976).
    """
    bound = begun.bound(sse=useful_sse(begun, len(begun.model.added) + 2))
    pairs = refit_pairs(fitter, begun.model, begun.screening.ranking, begun.floor, bound)
    found = {c.fitted.structure: c for c in pairs}
    large = leaves_more_than_noise(begun.model, begun.floor)
    for other in _other_forms(fitter, begun, pairs[0], bound) if large and pairs else ():
        found.setdefault(other.fitted.structure, other)
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
    """Refit other forms at the places of a pair, those of each effect at the model without it.

    Only where the pair does enough for a claim: of what it leaves, other forms change little.
    """
    if not begun.has(LoopPart.SIBLINGS) or not can_be_claimed(begun, pair.fitted):
        return []
    found: list[RefittedCandidate] = []
    model = pair.fitted
    for position in range(len(begun.model.added), len(model.added)):
        (rest,) = fitter.fit(LoopStage.REFITS, [model.start.minus(position)], full_refit(fitter))
        if rest is None or not can_be_linearised(fitter, rest):
            continue
        ranking, place = rank(fitter, begun.settings, rest), place_of(model.added[position])
        trials = [trial.candidate for trial in ranking.trials]
        there = [
            i
            for i in ranking.leaders(ranking.plain, len(trials))
            if place_of(trials[i]) == place and trials[i].effect.name not in model.structure
        ]
        steps = first_steps(fitter, rest, ranking, there[: REFINEMENT.finalists], bound)
        found += Growth(fitter, rest, begun.floor, bound).refit_steps(steps)
    return [replace(contender, move=LoopPart.SIBLINGS) for contender in found]


def _grown(
    fitter: Fitter,
    begun: RoundStart,
    parent: FittedModel,
    ranking: CandidateRanking,
    most: float = np.inf,
) -> list[RefittedCandidate]:
    """Refit structures with one effect more than a parent has; the best first, each once.

    What can neither come near a criterion of `most` nor be of use is refitted no further.
    """
    accepted = parent is begun.model
    bound = begun.bound(most + REFINEMENT.alternative, useful_sse(begun, len(parent.added) + 1))
    further = accepted and _leaves_much(begun)
    settings, floor = begun.settings, begun.floor
    found = refit(fitter, parent, ranking, floor, settings, further=further, bound=bound)
    found += refit_siblings(fitter, begun, parent, ranking, found)
    best: dict[frozenset[str], RefittedCandidate] = {}
    for contender in sorted(found, key=lambda c: c.criterion):
        best.setdefault(contender.fitted.structure, contender)
    return with_widths(fitter, begun, list(best.values()))


def _leaves_much(begun: RoundStart) -> bool:
    """Return whether what is missing is still large: the score of a small effect says enough."""
    closed = begun.base.sse - begun.model.sse
    return closed < REFINEMENT.closes * (begun.base.sse - begun.floor)


def _that_may_grow(
    fitter: Fitter, begun: RoundStart, best: RoundEnd
) -> Sequence[RefittedCandidate]:
    """Return all single effects; if noise could be the best, those that no noise could be."""
    first = best.seen.contenders[:1]
    if not first or beyond_coloured_noise(fitter, begun, first):
        return best.compared
    return beyond_coloured_noise(fitter, begun, best.compared)


def distinct(
    fitter: Fitter, begun: RoundStart, contenders: Sequence[RefittedCandidate]
) -> list[FittedModel]:
    """Return the best structures whose predictions differ, refitted to convergence.

    Structures that predict the same leave the same residual, and so lead to the same next effects:
    a second name for one of them would be a place lost.
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
    return best_first(fitter.records, fits)


def own_if_it_won(begun: RoundStart, best: RoundEnd, own: RoundEnd) -> RoundEnd:
    """The end of a move of last resort if it has won: it is tried only where nothing else has.

    Unless it wins it changes nothing, as long as no move after it reads what it has proposed;
    `exclude` reads what those before it have.
    """
    del begun
    return best if own.won is None else own


def better_of_free(begun: RoundStart, curve: RoundEnd, own: RoundEnd) -> RoundEnd:
    """What fits better, a free curve or a free filter; the log has the filters in any case."""
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
"""In the order in which they are tried."""


def drop(fitter: Fitter, begun: RoundStart, model: FittedModel) -> FittedModel:
    """Drop the effects that do not pay for themselves; one is left at least.

    Where what is left may be the noise of sensors, they must also pay in noise as coloured as that:
    slow noise always has some slow function that follows it. What closes too little for a claim is
    grown first: the next effect changes what it needs.
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
    """Return contenders, the best few with the widths of their switches where that pays.

    Only those that may come near the best by it. A form without a width would else win over one
    whose width is wrong.
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
    """Refit a structure with the widths of its switches as unknowns, where that pays.

    A dry friction is a switch; a simulation needs it to have a width. How wide matters little where
    the friction is small against the noise, so a search holds it. Where the friction is large the
    width is seen, and what a wrong one leaves would be patched with further effects. Each of some
    widths is simulated, and the linear model says how the other unknowns follow. What cannot come
    down to a criterion of `most` is not refitted.
    """
    held = _held_widths(model)
    if not held or not begun.has(LoopPart.SWITCH_WIDTHS):
        return model
    parameters = tuple(held.get(p.name, p) for p in model.problem.parameters)
    start = replace(model.start, problem=replace(model.problem, parameters=parameters))
    space = fitter.space(start)
    points = np.tile(space.start, (len(WIDTHS), 1))
    for i, unknown in enumerate(space.unknowns):
        if unknown.label in held:  # in logarithms
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
    """The parameters that hold widths of switches, by name, free between the ends of their grids.

    Widths are small parts of how much their variables move. What a power law refers to is held for
    good, and no width.
    """
    known = {p.name: p for p in model.problem.parameters if p.fixed}
    found = {}
    for candidate in model.added:
        columns = zip(*candidate.grid, strict=True)
        for c, values in zip(candidate.form.coefficients, columns, strict=True):
            held = known.get(f"{candidate.effect.name}.{c.name}")
            if held is not None and c.scale is GridScale.RMS_V:
                bounds = min(*values, held.start), held.upper  # a start may be below by rounding
                found[held.name] = replace(held, fixed=False, bounds=bounds, scale="log")
    return found
