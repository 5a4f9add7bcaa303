"""Fits from several starts, so that a local minimum is not mistaken for a missing effect.

The declared model: if the fit from the user's start does not reach the noise, other starts grow
through longer and longer parts of every record: on a short part the cost has few minima, and what
is found there lies near the right one on a longer part. A structure: a local minimum looks like a
wrong name, so it is refitted from the declared parameters and with other shapes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import SHORTENED, FitStart, FittedModel, Fitter
from cluster_est.closed_loop.output_noise import noise_of
from cluster_est.closed_loop.selection.linear_model import (
    REFINEMENT,
    gauss_newton_step,
    longest_step,
)
from cluster_est.closed_loop.selection.prediction import is_usable
from cluster_est.closed_loop.selection.refits import SHORT, full_refit
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
    at_noise
        Residual over noise below which no other start is tried. Benchmark.
    spread
        Of the starts around the user's: in logarithms, or as a share of a value. Benchmark.
    survivors
        Starts that go on after each horizon. Benchmark.
    distinct
        Relative distance of two fits that count as different. Benchmark.
    """

    at_noise: float = 1.05
    spread: float = 0.35
    survivors: tuple[int, ...] = (4, 2)
    distinct: float = 1e-2


DECLARED_MODEL = DeclaredModelThresholds()


THOROUGH = LeastSquares(trials=1, max_iterations=25, ftol=1e-7, xtol=1e-8, differences="forward")
BRIEF = LeastSquares(trials=1, max_iterations=8, ftol=1e-4, xtol=1e-5, differences="forward")


def fit_declared(
    fitter: Fitter, start: FitStart, count: int, known: FittedModel | None = None
) -> FittedModel:
    """Fit from the user's start, and from others unless that reaches the noise.

    With process noise it is the one start: a filter follows what is measured from wherever it
    stands, so that there is no growing along a record.

    Parameters
    ----------
    start
        Of the model.
    count
        Number of starts where one is not enough.
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
    noise = noise_of(fitter, fitted.residuals)
    for output, sigma in enumerate(noise.tolist()):
        part = fitted.residuals[fitter.records.of_output(output)]
        if len(part) and np.sqrt(np.mean(part**2)) > DECLARED_MODEL.at_noise * sigma:
            return False
    return True


def _grow(fitter: Fitter, start: FitStart, count: int) -> list[FittedModel | None]:
    """Several starts through the horizons to the full records."""
    starts = _spread(fitter, start, count)
    for horizon, survivors in zip(SHORTENED, DECLARED_MODEL.survivors, strict=True):
        fits = fitter.fit(LoopStage.DECLARED_MODEL, starts, BRIEF, horizon)
        alive = sorted((f for f in fits if f is not None), key=lambda f: f.sse)
        starts = [
            FitStart(start.problem, fitter.measured_estimates(f, horizon), start.added)
            for f in _distinct(alive, DECLARED_MODEL.distinct)[:survivors]
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
    spread = DECLARED_MODEL.spread
    return [
        FitStart(start.problem, space.estimates(_moved(space, shared, row, spread)), start.added)
        for row in cube
    ]


def _moved(space: SearchSpace, shared: Sequence[int], row: FloatArray, spread: float) -> FloatArray:
    x = space.start.copy()
    for i, way in zip(shared, row.tolist(), strict=False):
        x[i] += spread * way * (1.0 if space.unknowns[i].log else space.typical[i])
    return np.asarray(np.clip(x, space.lower, space.upper))


def _distinct(fits: Sequence[FittedModel], distance: float) -> list[FittedModel]:
    """Fits at different points, the best of each."""
    kept: list[FittedModel] = []
    for fit in fits:
        log = fit.space.logarithmic
        sizes = np.where(log, 1.0, np.maximum(np.abs(fit.x), fit.space.typical))
        if all(np.abs((fit.x - other.x) / sizes).max() > distance for other in kept):
            kept.append(fit)
    return kept


def refit_from_other_starts(
    fitter: Fitter, declared: FittedModel, grown: FittedModel
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
    grown: FittedModel,
    space: SearchSpace,
    point: FloatArray,
    residuals: FloatArray,
) -> FloatArray:
    """A point, after the Gauss-Newton step of all unknowns that it has in common with the fit."""
    same = point == grown.x
    step = gauss_newton_step(grown.jacobian[:, same], residuals)
    largest = REFINEMENT.largest_step
    most = longest_step(space, grown.x, largest)[same]
    moved = point.copy()
    moved[same] += np.clip(step, -most, most)
    return np.asarray(np.clip(moved, space.lower, space.upper))


def _other_shapes(fitter: Fitter, grown: FittedModel) -> Iterator[FloatArray]:
    """The fit, with the shape of one effect at each point of its grid, in search coordinates."""
    values = grown.estimates
    for candidate in grown.added:
        for shape in _shapes(candidate):
            known = {label: value for label, value in shape.items() if label in values}
            if known:
                start = FitStart(grown.problem, values | known, grown.added)
                yield fitter.space(start).start


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
