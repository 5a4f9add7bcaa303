"""Refits of a structure from other starts: a local minimum looks like a wrong name."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.selection.accept import is_usable
from cluster_est.closed_loop.selection.refinement.linear_step import (
    gauss_newton_step,
    longest_step,
)
from cluster_est.closed_loop.selection.refinement.refits import SHORT, full_refit
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray


def refit_from_other_starts(
    workbench: LoopWorkbench, declared: FittedModel, grown: FittedModel
) -> FittedModel:
    """Refit from the declared parameters, and with shapes at the best points of their grids.

    The declared parameters are those of the fitted model, and the user's own starts: what has to
    make room for a missing effect may have led the fit to where there is no way back. Every point
    of a grid is simulated; the best are refitted a little, and the best of those to convergence,
    the user's starts in any case.

    Returns
    -------
    FittedModel
        The same structure where it fits best.
    """
    values = grown.estimates
    space = workbench.space(grown.start)
    shapes = _best_first(workbench, grown, space, list(_other_shapes(workbench, grown)))
    given = workbench.space(FitStart(declared.problem, {}))
    starts = [values | given.estimates(given.start), values | declared.estimates]
    starts += [space.estimates(x) for x in shapes[: workbench.thresholds.refinement.finalists]]
    fits = workbench.fit(
        LoopStage.OTHER_STARTS,
        [FitStart(grown.problem, start, grown.added) for start in starts],
        SHORT,
    )
    brief = [fitted for fitted in fits if fitted is not None]
    if not brief:
        return grown
    best = min(brief, key=lambda fitted: fitted.sse)
    going = [best] if fits[0] is None or fits[0] is best else [best, fits[0]]
    finished = workbench.fit(
        LoopStage.OTHER_STARTS, [fitted.start for fitted in going], full_refit(workbench)
    )
    better = [each for each in finished if each is not None and each.sse < grown.sse]
    for each in sorted(better, key=lambda fitted: fitted.sse):
        if is_usable(workbench, each, declared):
            return each
    return grown


def _best_first(
    workbench: LoopWorkbench, grown: FittedModel, space: SearchSpace, shapes: list[FloatArray]
) -> list[FloatArray]:
    """Points with other shapes, the lowest sum of squares first.

    Each is simulated as it is, and again after the step by which the linear model of the fit makes
    the other unknowns follow; the better one stands for it. What cannot be simulated is left out.
    """
    if not shapes:
        return []
    plain, adapted = np.array(shapes), np.array(shapes)
    found: dict[int, tuple[float, FloatArray]] = {}
    for points in (plain, adapted):
        (answers,) = workbench.evaluate(LoopStage.OTHER_STARTS, [(space, points)])
        for i, at in enumerate(answers):
            if not at.ok:
                continue
            sse = float(np.add.reduce(at.residuals**2))
            if i not in found or sse < found[i][0]:
                found[i] = sse, points[i]
            if points is plain:
                adapted[i] = _adapted(workbench, grown, space, plain[i], at.residuals)
    return [point for _, point in sorted(found.values(), key=lambda known: known[0])]


def _adapted(
    workbench: LoopWorkbench,
    grown: FittedModel,
    space: SearchSpace,
    point: FloatArray,
    residuals: FloatArray,
) -> FloatArray:
    """A point, after the Gauss-Newton step of all unknowns that it has in common with the fit."""
    same = point == grown.x
    step = gauss_newton_step(grown.jacobian[:, same], residuals)
    largest = workbench.thresholds.refinement.largest_step
    most = longest_step(space, grown.x, largest)[same]
    moved = point.copy()
    moved[same] += np.clip(step, -most, most)
    return np.asarray(np.clip(moved, space.lower, space.upper))


def _other_shapes(workbench: LoopWorkbench, grown: FittedModel) -> Iterator[FloatArray]:
    """The fit, with the shape of one effect at each point of its grid, in search coordinates."""
    values = grown.estimates
    for candidate in grown.added:
        for shape in _shapes(candidate):
            known = {label: value for label, value in shape.items() if label in values}
            if known:
                start = FitStart(grown.problem, values | known, grown.added)
                yield workbench.space(start).start


def _shapes(candidate: EffectCandidate) -> list[dict[str, float]]:
    """What is no strength, at each point of the candidate's grid; nothing where that is one."""
    if len(candidate.grid) < 2:
        return []
    names = [c.name for c in candidate.form.coefficients]
    return [
        {
            f"{candidate.effect.name}.{name}": value
            for name, value in zip(names, row, strict=True)
            if name not in candidate.strengths
        }
        for row in candidate.grid
    ]
