"""Neighbours of a refitted candidate: other functions of its argument, and other switch widths.

The screening sees a small step from a model that lacks the effect. Where the effect is large the
motion with it is another one, on which two functions differ that looked alike before, and the
shortlist may have held the wrong one. So once a candidate has been refitted, the other functions of
its argument (sibling forms) are compared with it along the trajectory that it has led to, by linear
algebra, and those that could do the same are refitted from there.

A dry friction is a switch; a simulation needs it to have a width. How wide matters little where the
friction is small against the noise, so a search holds it. Where the friction is large the width is
seen, and what a wrong one leaves would be patched with further effects.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate, denser_grid
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.screen import CandidateRanking, candidate_columns
from cluster_est.closed_loop.selection.acceptance import can_be_linearised
from cluster_est.closed_loop.selection.linear_model import (
    REFINEMENT,
    PruningBound,
    can_reach_with,
    gauss_newton_step,
    is_proportional,
    shares_left,
    values_at,
)
from cluster_est.closed_loop.selection.refits import (
    SHORT,
    RefittedCandidate,
    best_first,
    full_refit,
    refit_fully,
)
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.methods.method import Evaluation
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import SearchSpace
from cluster_est.statistics.projection import OrthogonalProjection
from workers.effects.kinds import GridScale
from workers.messages import FloatArray


def refit_siblings(
    fitter: Fitter,
    begun: RoundStart,
    current: FittedModel,
    ranking: CandidateRanking,
    contenders: Sequence[RefittedCandidate],
) -> list[RefittedCandidate]:
    """Refit other functions of the argument of the best contender, from where that one stands.

    In co-simulation, where nothing is known along the way, nothing is compared.

    Parameters
    ----------
    current, ranking
        The model that candidates are added to, and all candidates at it.
    contenders
        Refitted candidates, the best first. Those that converged are not refitted again.
    """
    if not begun.has(LoopPart.SIBLINGS) or not fitter.by_linear_systems:
        return []
    if not contenders or not contenders[0].full:
        return []
    best = contenders[0]
    done = {c.candidate.effect.name for c in contenders if c.full}
    named = {t.candidate.effect.name: t.candidate for t in ranking.trials}
    rivals = [candidate for candidate in named.values() if _is_rival(candidate, best, done)]
    if not rivals or not can_be_linearised(fitter, best.fitted):
        return []
    trajectories = fitter.trajectories(best.fitted)
    trials = [
        CandidatePoint(candidate, values)
        for candidate in rivals
        for values in denser_grid(candidate, trajectories)
    ]
    starts = starts_in_its_place(fitter, current, best, trials, REFINEMENT.finalists)
    fits = [f for f in fitter.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    brief = best_first(fitter.records, fits, LoopPart.SIBLINGS, full=False)
    most = best.criterion + REFINEMENT.alternative
    near = refit_fully(fitter, [c.fitted for c in brief if c.criterion < most])
    far = [c for c in brief if c.criterion >= most]
    return [*best_first(fitter.records, near, LoopPart.SIBLINGS), *far]


def _is_rival(candidate: EffectCandidate, best: RefittedCandidate, done: Collection[str]) -> bool:
    """Return whether it is a function of the same argument; without one, at the same site."""
    own = best.candidate
    if candidate.form.free or candidate.effect.name in done:
        return False
    same = candidate.effect.variables == own.effect.variables
    return same and bool(own.effect.variables or candidate.site == own.site)


def starts_in_its_place(
    fitter: Fitter,
    current: FittedModel,
    best: RefittedCandidate,
    trials: Sequence[CandidatePoint],
    most: int,
) -> list[FitStart]:
    """Return the best candidate's model with the likeliest others in its place, at most some.

    Along its trajectory, what they should do is what it does and what it leaves; those that could
    not do as much are left out. `current` is the model that it was added to.
    """
    fitted = best.fitted
    name, values = best.candidate.effect.name, fitted.coefficients(best.candidate)
    own = CandidatePoint(best.candidate, best.candidate.point(values))
    columns = candidate_columns(fitter, fitted, _before(fitter, current, best), [own, *trials])
    strengths = best.candidate.sizes(values)
    target = columns[0] @ np.array(strengths or [1.0]) - fitted.residuals
    labels = [unknown.label for unknown in fitted.space.unknowns]
    others = [i for i, label in enumerate(labels) if not label.startswith(f"{name}.")]
    projection = OrthogonalProjection(fitted.jacobian[:, others])
    target = projection.remove(target)
    without = fitted.start.minus(len(fitted.added) - 1)
    found: dict[str, tuple[float, FitStart]] = {}
    for trial, column in zip(trials, columns[1:], strict=True):
        share, sizes = explained_share(
            target, projection.remove(column), free=is_proportional(trial)
        )
        rival = trial.candidate
        if share > found.get(rival.effect.name, (REFINEMENT.explains,))[0]:
            start = without.plus(rival, values_at(trial, sizes))
            found[rival.effect.name] = share, start
    ranked = sorted(found.values(), key=lambda each: -each[0])
    return [start for _, start in ranked[:most]]


def explained_share(
    target: FloatArray, columns: FloatArray, *, free: bool
) -> tuple[float, FloatArray]:
    """Return the share of a target's squares that columns explain, and the strength of each.

    If not `free` to be scaled, they count as they are and have no strengths.
    """
    lengths = np.linalg.norm(columns, axis=0)
    whole = float(np.add.reduce(target**2))
    if not whole > 0.0 or not (lengths > 0.0).all():
        return 0.0, np.zeros(columns.shape[1] if free else 0)
    if not free:
        return 1.0 - float(np.add.reduce((target - columns[:, 0]) ** 2)) / whole, np.zeros(0)
    sizes = np.linalg.lstsq(columns / lengths, target, rcond=1e-6)[0] / lengths
    return 1.0 - float(np.add.reduce((target - columns @ sizes) ** 2)) / whole, sizes


def _before(
    fitter: Fitter, current: FittedModel, best: RefittedCandidate
) -> list[LinearisedTrajectory]:
    """Trajectories with the best candidate; an input at which it acts is as it was before it."""
    trajectories = fitter.trajectories(best.fitted)
    site = best.candidate.site
    if site.kind != "input":
        return trajectories
    return [
        replace(
            new,
            signals={
                **new.signals,
                site.target: np.interp(new.times, old.times, old.signals[site.target]),
            },
        )
        for new, old in zip(trajectories, fitter.trajectories(current), strict=True)
    ]


TRIED = (0.3, 2.5, 8.0, 25.0)
"""Widths that are tried, over the held one: a switch may be wider than a search holds it."""


def refit_switch_widths(
    fitter: Fitter,
    begun: RoundStart,
    contenders: Sequence[RefittedCandidate],
    most: float = np.inf,
) -> list[RefittedCandidate]:
    """Refit the best contenders with the widths of their switches as unknowns.

    Only those that may come near the best by it, whether they converged or not; a width stays an
    unknown where that pays. Above a criterion of `most` a structure is of no use. Returned are the
    same structures, each once, the best first.
    """
    best: dict[frozenset[str], RefittedCandidate] = {}
    for contender in sorted(contenders, key=lambda c: c.criterion):
        best.setdefault(contender.fitted.structure, contender)
    ranked = list(best.values())
    asked = [i for i, c in enumerate(ranked) if _held_widths(c.fitted)][: REFINEMENT.finalists]
    asked = asked if begun.has(LoopPart.SWITCH_WIDTHS) else []
    near = min([most, *(c.criterion + REFINEMENT.alternative for c in ranked[:1])])
    hopeful = _starts_that_may_pay(fitter, [ranked[i] for i in asked], near)
    asked = [i for i, start in zip(asked, hopeful, strict=True) if start is not None]
    starts = [start for start in hopeful if start is not None]
    fits = fitter.fit(LoopStage.REFITS, starts, full_refit(fitter))
    for i, fitted in zip(asked, fits, strict=True):
        if fitted is None:
            continue
        criterion = fitted.criterion(fitter.records)
        if criterion < ranked[i].criterion:
            ranked[i] = RefittedCandidate(fitted, criterion, True, LoopPart.SWITCH_WIDTHS)
    return sorted(ranked, key=lambda c: c.criterion)


def _starts_that_may_pay(
    fitter: Fitter, contenders: Sequence[RefittedCandidate], most: float
) -> list[FitStart | None]:
    """Where to refit each from, with its widths unknown; None where no width would be of use.

    Each is simulated with other widths, and the linear model says how the other unknowns follow.
    Where a refit was broken off the linear model says too little: it is refitted in any case.
    """
    starts = [_with_free_widths(contender.fitted) for contender in contenders]
    found: list[FitStart | None] = list(starts)
    asked = [i for i, contender in enumerate(contenders) if contender.full]
    points = []
    for i in asked:
        space = fitter.space(starts[i])
        points.append((space, _other_widths(contenders[i].fitted, space)))
    answers = fitter.evaluate(LoopStage.TRIALS, points)
    for i, (space, widths), seen in zip(asked, points, answers, strict=True):
        best = _best_width(fitter, contenders[i], space, widths, seen, most)
        known = None if best is None else {**starts[i].values, **space.estimates(best)}
        found[i] = None if known is None else replace(starts[i], values=known)
    return found


def _best_width(
    fitter: Fitter,
    contender: RefittedCandidate,
    space: SearchSpace,
    points: FloatArray,
    answers: Sequence[Evaluation],
    most: float,
) -> FloatArray | None:
    """The point with the best widths, if it may lower the criterion enough to be of any use."""
    fitted, found = contender.fitted, []
    for point, at in zip(points, answers, strict=True):
        if at.ok:
            step = gauss_newton_step(fitted.jacobian, at.residuals)
            after = at.residuals + fitted.jacobian @ step
            found.append((float(np.add.reduce(after**2)), after, point))
    if not found:
        return None
    _, after, point = min(found, key=lambda each: each[0])
    left = shares_left(fitter.records, fitted.residuals, after)
    bound = PruningBound(criterion=min(contender.criterion, most))
    added = space.size - fitted.space.size
    return point if can_reach_with(fitter.records, fitted, left, added, bound) else None


def _other_widths(fitted: FittedModel, space: SearchSpace) -> FloatArray:
    """Points (widths, unknowns) with other widths than those that are held."""
    held = {p.name: p.start for p in fitted.problem.parameters if p.fixed}
    points = np.tile(space.start, (len(TRIED), 1))
    for i, unknown in enumerate(space.unknowns):
        if unknown.label in held:  # in logarithms
            points[:, i] = np.log(held[unknown.label]) + np.log(TRIED)
    return np.asarray(np.clip(points, space.lower, space.upper))


def _held_widths(fitted: FittedModel) -> dict[str, tuple[float, float]]:
    """The parameters that hold widths, with the narrowest and the widest of a search.

    Widths are small parts of how much their variables move. What a power law refers to is held for
    good, and no width.
    """
    held = {p.name for p in fitted.problem.parameters if p.fixed}
    ranges = {}
    for candidate in fitted.added:
        columns = zip(*candidate.grid, strict=True)
        for c, values in zip(candidate.form.coefficients, columns, strict=True):
            name = f"{candidate.effect.name}.{c.name}"
            if name in held and c.scale is GridScale.RMS_V:
                ranges[name] = min(values), max(values)
    return ranges


def _with_free_widths(fitted: FittedModel) -> FitStart:
    """A start from the estimates of a fit, with its widths among the unknowns.

    They start from the widest, unless a better one is known: what is too narrow to be seen gives a
    fit no direction.
    """
    start, ranges = fitted.start, _held_widths(fitted)

    def released(parameter: Parameter) -> Parameter:
        if parameter.name not in ranges:
            return parameter
        narrowest, widest = ranges[parameter.name]
        bounds = narrowest, parameter.upper
        return replace(parameter, start=widest, fixed=False, bounds=bounds, scale="log")

    parameters = tuple(released(p) for p in start.problem.parameters)
    return replace(start, problem=replace(start.problem, parameters=parameters))
