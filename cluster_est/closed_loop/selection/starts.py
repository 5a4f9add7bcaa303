"""Fits from several starts, so that a local minimum is not mistaken for a missing effect.

The declared model: if the fit from the user's start does not reach the noise, other starts grow
through longer and longer parts of every record: on a short part the cost has few minima, and what
is found there lies near the right one on a longer part. A structure: a local minimum looks like a
wrong name, so it is refitted from the declared parameters and with other shapes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.fitter import SHORTENED, FitStart, FittedModel, Fitter
from cluster_est.closed_loop.output_noise import noise_of
from cluster_est.closed_loop.selection.acceptance import is_usable
from cluster_est.closed_loop.selection.linear_model import (
    REFINEMENT,
    gauss_newton_step,
    longest_step,
)
from cluster_est.closed_loop.selection.refits import SHORT, full_refit
from cluster_est.closed_loop.selection.rounds import VERDICT
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.sensors import unstarted_sensors
from workers.messages import FloatArray


@dataclass(frozen=True)
class DeclaredModelThresholds:
    """Thresholds of the fit of the declared model.

    Attributes
    ----------
    spread
        Of the starts around the user's: in logarithms, or as a share of a value. Benchmark.
    survivors
        Starts that go on after each horizon. Benchmark.
    distinct
        Relative distance of two fits that count as different. Benchmark.
    """

    spread: float = 0.35
    survivors: tuple[int, ...] = (4, 2)
    distinct: float = 1e-2


DECLARED_MODEL = DeclaredModelThresholds()


THOROUGH = LeastSquares(trials=1, max_iterations=25, ftol=1e-7, xtol=1e-8, differences="forward")
BRIEF = LeastSquares(trials=1, max_iterations=8, ftol=1e-4, xtol=1e-5, differences="forward")


def fit_declared(
    fitter: Fitter, start: FitStart, count: int, known: FittedModel | None = None
) -> FittedModel:
    """Fit from the user's start, and from some others unless that reaches the noise.

    With process noise it is the one start: a filter follows what is measured from wherever it
    stands, so that there is no growing along a record.

    Parameters
    ----------
    known
        The fit from the user's start, where there is one.

    Raises
    ------
    ProblemError
        If the model cannot be simulated at its start.
    """
    first = known if not start.values else None
    if first is None:
        (first,) = fitter.fit(LoopStage.DECLARED_MODEL, [start], THOROUGH)
    if first is not None and (fitter.predicts or at_noise(fitter, first)):
        return first
    grown = _grow(fitter, start, count)
    best = [f for f in (first, *grown) if f is not None]
    if not best:
        raise ProblemError(
            "closed loop: the declared model cannot be simulated from its start values; try "
            "cluster-est check, and other start values"
        )
    return min(best, key=lambda fitted: fitted.sse)


def at_noise(fitter: Fitter, fitted: FittedModel) -> bool:
    """Return whether the residual is as small as its own roughness says it can be."""
    most = np.sqrt(VERDICT.gap) * noise_of(fitter, fitted.residuals)
    parts = fitter.records.by_output(fitted.residuals)
    return not any(
        len(part) and np.sqrt(np.mean(part**2)) > level
        for part, level in zip(parts, most.tolist(), strict=True)
    )


def _grow(fitter: Fitter, start: FitStart, count: int) -> list[FittedModel | None]:
    """Several starts through the horizons to the full records."""
    starts = _spread(fitter, start, count)
    for horizon, survivors in zip(SHORTENED, DECLARED_MODEL.survivors, strict=True):
        fits = fitter.fit(LoopStage.DECLARED_MODEL, starts, BRIEF, horizon)
        alive = sorted((f for f in fits if f is not None), key=lambda f: f.sse)
        starts = [
            replace(start, values=fitter.measured_estimates(f, horizon))
            for f in _distinct(alive)[:survivors]
        ]
    return fitter.fit(LoopStage.DECLARED_MODEL, starts, THOROUGH)


def _spread(fitter: Fitter, start: FitStart, count: int) -> list[FitStart]:
    """The user's start, and points of a Sobol sequence around it for the shared values."""
    from scipy.stats import qmc  # slow to import, and only a fit that misses the noise asks for it

    space = fitter.space(start)
    sensors = {i for sensor in unstarted_sensors(space) for i in sensor.unknowns}
    shared = [i for i, u in enumerate(space.unknowns) if not u.scope and i not in sensors]
    sampler = qmc.Sobol(max(1, len(shared)), rng=fitter.generator(1))
    cube = 2.0 * sampler.random(1 << (count - 1).bit_length())[:count] - 1.0
    cube[0] = 0.0
    return [replace(start, values=space.estimates(_moved(space, shared, row))) for row in cube]


def _moved(space: SearchSpace, shared: Sequence[int], row: FloatArray) -> FloatArray:
    x = space.start.copy()
    for i, way in zip(shared, row.tolist(), strict=False):
        size = 1.0 if space.unknowns[i].log else space.typical[i]
        x[i] += DECLARED_MODEL.spread * way * size
    return np.asarray(np.clip(x, space.lower, space.upper))


def _distinct(fits: Sequence[FittedModel]) -> list[FittedModel]:
    """Fits at different points, the best of each."""
    kept: list[FittedModel] = []
    for fit in fits:
        sizes = longest_step(fit.space, fit.x, DECLARED_MODEL.distinct)
        if all(np.any(np.abs(fit.x - other.x) > sizes) for other in kept):
            kept.append(fit)
    return kept


def refit_from_other_starts(
    fitter: Fitter, declared: FittedModel, grown: FittedModel
) -> FittedModel:
    """Refit a structure from the declared parameters, and with shapes at the best points of grids.

    The declared parameters are those of the fitted model, and the user's own starts: what has to
    make room for a missing effect may have led the fit to where there is no way back. Every point
    of a grid is simulated; the best are refitted a little, and the best of those to convergence,
    the user's starts in any case.
    """
    values = grown.estimates
    space = fitter.space(grown.start)
    shapes = _best_first(fitter, grown, space, list(_other_shapes(fitter, grown)))
    given = fitter.space(FitStart(declared.problem, {}))
    starts = [values | given.estimates(given.start), values | declared.estimates]
    starts += [space.estimates(x) for x in shapes[: REFINEMENT.finalists]]
    fits = fitter.fit(
        LoopStage.OTHER_STARTS,
        [FitStart(grown.problem, start, grown.added) for start in starts],
        SHORT,
    )
    brief = [fitted for fitted in fits if fitted is not None]
    if not brief:
        return grown
    best = min(brief, key=lambda fitted: fitted.sse)
    going = [best] if fits[0] is None or fits[0] is best else [best, fits[0]]
    finished = fitter.fit(
        LoopStage.OTHER_STARTS, [fitted.start for fitted in going], full_refit(fitter)
    )
    better = [each for each in finished if each is not None and each.sse < grown.sse]
    for each in sorted(better, key=lambda fitted: fitted.sse):
        if is_usable(fitter, each, declared):
            return each
    return grown


def _best_first(
    fitter: Fitter, grown: FittedModel, space: SearchSpace, shapes: list[FloatArray]
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
        (answers,) = fitter.evaluate(LoopStage.OTHER_STARTS, [(space, points)])
        for i, at in enumerate(answers):
            if not at.ok:
                continue
            sse = float(np.add.reduce(at.residuals**2))
            if i not in found or sse < found[i][0]:
                found[i] = sse, points[i]
            if points is plain:
                adapted[i] = _adapted(grown, space, plain[i], at.residuals)
    return [point for _, point in sorted(found.values(), key=lambda known: known[0])]


def _adapted(
    grown: FittedModel, space: SearchSpace, point: FloatArray, residuals: FloatArray
) -> FloatArray:
    """A point, after the Gauss-Newton step of all unknowns that it has in common with the fit."""
    same = point == grown.x
    step = gauss_newton_step(grown.jacobian[:, same], residuals)
    most = longest_step(space, grown.x, REFINEMENT.largest_step)[same]
    moved = point.copy()
    moved[same] += np.clip(step, -most, most)
    return np.asarray(np.clip(moved, space.lower, space.upper))


def _other_shapes(fitter: Fitter, grown: FittedModel) -> Iterator[FloatArray]:
    """The fit, with the shape of one effect at each point of its grid, in search coordinates."""
    values = grown.estimates
    for candidate in (each for each in grown.added if len(each.grid) > 1):
        labels = [f"{candidate.effect.name}.{c.name}" for c in candidate.form.coefficients]
        strengths = [f"{candidate.effect.name}.{name}" for name in candidate.strengths]
        free = [i for i, label in enumerate(labels) if label in values and label not in strengths]
        for row in candidate.grid if free else ():
            shape = {labels[i]: row[i] for i in free}
            yield fitter.space(replace(grown.start, values=values | shape)).start
