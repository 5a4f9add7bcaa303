"""Widths of switches, held while candidates are compared, and fitted where that matters.

A dry friction is a switch; a simulation needs it to have a width. How wide matters little where the
friction is small against the noise, so a search holds it. Where the friction is large the width is
seen, and what a wrong one leaves would be patched with further effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.selection.refinement.linear_step import gauss_newton_step
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.refinement.refits import full_refit
from cluster_est.closed_loop.selection.refinement.useful_fit import (
    UsefulFit,
    may_start_useful,
    shares_left,
)
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, LoopWorkbench
from cluster_est.methods.method import Evaluation
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import SearchSpace
from workers.effects.kinds import GridScale
from workers.messages import FloatArray

WIDTH = GridScale.RMS_V
"""Of a width that is held: a small part of how much its variable moves."""


TRIED = (0.3, 2.5, 8.0, 25.0)
"""Widths that are tried, over the held one: a switch may be wider than a search holds it."""


def refit_switch_widths(
    workbench: LoopWorkbench,
    contenders: Sequence[RefittedCandidate],
    most: float = np.inf,
) -> list[RefittedCandidate]:
    """Refit the best contenders with the widths of their switches as unknowns.

    Only those that may come near the best by it, whether they converged or not; a width stays an
    unknown where that pays.

    Parameters
    ----------
    contenders
        Refitted candidates, in any order.
    most
        Criterion above which a structure is of no use.

    Returns
    -------
    list of RefittedCandidate
        The same structures, each once, the best first.
    """
    thresholds = workbench.thresholds.refinement
    best: dict[frozenset[str], RefittedCandidate] = {}
    for contender in sorted(contenders, key=lambda c: c.criterion):
        best.setdefault(contender.fitted.structure, contender)
    ranked = list(best.values())
    asked = [i for i, c in enumerate(ranked) if _held(c)][: thresholds.finalists]
    near = min([most, *(c.criterion + thresholds.alternative for c in ranked[:1])])
    hopeful = _starts_that_may_pay(workbench, [ranked[i] for i in asked], near)
    asked = [i for i, start in zip(asked, hopeful, strict=True) if start is not None]
    starts = [start for start in hopeful if start is not None]
    fits = workbench.fit(LoopStage.REFITS, starts, full_refit(workbench))
    for i, fitted in zip(asked, fits, strict=True):
        if fitted is None:
            continue
        criterion = fitted.criterion(workbench.records)
        if criterion < ranked[i].criterion:
            ranked[i] = RefittedCandidate(fitted, criterion, True)
    return sorted(ranked, key=lambda c: c.criterion)


def _starts_that_may_pay(
    workbench: LoopWorkbench, contenders: Sequence[RefittedCandidate], most: float
) -> list[FitStart | None]:
    """Where to refit each from, with its widths unknown; None where no width would be of use.

    Each is simulated with other widths, and the linear model says how the other unknowns follow.
    Where a refit was broken off the linear model says too little: it is refitted in any case.
    """
    starts: list[FitStart | None] = [_released(contender) for contender in contenders]
    asked = [i for i, contender in enumerate(contenders) if contender.full]
    spaces = [workbench.space(_released(contenders[i])) for i in asked]
    points = [
        (space, _other_widths(contenders[i], space)) for i, space in zip(asked, spaces, strict=True)
    ]
    answers = workbench.evaluate(LoopStage.TRIALS, points)
    for i, (space, widths), seen in zip(asked, points, answers, strict=True):
        starts[i] = _best_width(workbench, contenders[i], space, widths, seen, most)
    return starts


def _best_width(
    workbench: LoopWorkbench,
    contender: RefittedCandidate,
    space: SearchSpace,
    points: FloatArray,
    answers: Sequence[Evaluation],
    most: float,
) -> FitStart | None:
    """The best of some widths, if it may lower the criterion enough to be of any use."""
    fitted, found = contender.fitted, []
    for point, at in zip(points, answers, strict=True):
        if at.ok:
            step = gauss_newton_step(fitted.jacobian, at.residuals)
            after = at.residuals + fitted.jacobian @ step
            found.append((float(np.add.reduce(after**2)), after, point))
    if not found:
        return None
    _, after, point = min(found, key=lambda each: each[0])
    left = shares_left(workbench.records, fitted.residuals, after)
    useful = UsefulFit(criterion=min(contender.criterion, most))
    if not may_start_useful(workbench, fitted, left, space.size - fitted.space.size, useful):
        return None
    start = _released(contender)
    return FitStart(start.problem, {**start.values, **space.estimates(point)}, start.added)


def _other_widths(contender: RefittedCandidate, space: SearchSpace) -> FloatArray:
    """Points (widths, unknowns) with other widths than those that are held."""
    held = {p.name: p.start for p in contender.fitted.problem.parameters if p.fixed}
    points = np.tile(space.start, (len(TRIED), 1))
    for i, unknown in enumerate(space.unknowns):
        if unknown.label in held:  # in logarithms
            points[:, i] = np.log(held[unknown.label]) + np.log(TRIED)
    return np.asarray(np.clip(points, space.lower, space.upper))


def _held(contender: RefittedCandidate) -> dict[str, tuple[float, float]]:
    """The parameters that hold widths, with the narrowest and the widest of a search."""
    ranges = {k: v for c in contender.fitted.added for k, v in _widths(c).items()}
    held = {p.name for p in contender.fitted.problem.parameters if p.fixed}
    return {name: ends for name, ends in ranges.items() if name in held}


def _widths(candidate: EffectCandidate) -> dict[str, tuple[float, float]]:
    """The ranges of its widths. What a power law refers to is no width, and held for good."""
    columns = zip(candidate.form.coefficients, zip(*candidate.grid, strict=True), strict=True)
    return {
        f"{candidate.effect.name}.{c.name}": (min(values), max(values))
        for c, values in columns
        if c.held and c.scale is WIDTH
    }


def _released(contender: RefittedCandidate) -> FitStart:
    """A start from the contender's estimates, with its widths among the unknowns.

    They start from the widest, unless a better one is known: what is too narrow to be seen gives a
    fit no direction.
    """
    start, ranges = contender.fitted.start, _held(contender)

    def released(parameter: Parameter) -> Parameter:
        if parameter.name not in ranges:
            return parameter
        narrowest, widest = ranges[parameter.name]
        return replace(parameter, start=widest, fixed=False, lower=narrowest, scale="log")

    parameters = tuple(released(p) for p in start.problem.parameters)
    return FitStart(replace(start.problem, parameters=parameters), start.values, start.added)
