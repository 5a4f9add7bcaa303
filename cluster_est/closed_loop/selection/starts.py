"""Fits from several starts, so that a local minimum is not mistaken for a missing effect.

If the fit from the user's start does not reach the noise, other starts are fitted to increasing
parts of every record. On a short part, the cost has few minima, and the one found lies near the
right one on a longer part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.fitter import SHORTENED, FitStart, FittedModel, Fitter
from cluster_est.closed_loop.output_noise import noise_of
from cluster_est.closed_loop.selection.linear_model import (
    longest_step,
)
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
        Distance of other starts from the user's: in logarithms, or relative to a value. Benchmark.
    survivors
        Number of starts that are kept after each horizon. Benchmark.
    distinct
        Relative distance from which two fits count as different. Benchmark.
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
    """Fit from the user's start, and from other starts if this fit does not reach the noise.

    With process noise, only the user's start is used: a Kalman filter follows the measurements from
    any start, so a short part of a record is not easier to fit.

    Parameters
    ----------
    known
        The fit from the user's start, if it is known.

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
            "close-loop: the declared model cannot be simulated from its start values; run "
            "cluster-est check, or try other start values"
        )
    return min(best, key=lambda fitted: fitted.sse)


def at_noise(fitter: Fitter, fitted: FittedModel) -> bool:
    """Return whether the residual of each output is about as small as its estimated noise."""
    most = np.sqrt(VERDICT.gap) * noise_of(fitter, fitted.residuals)
    parts = fitter.records.by_output(fitted.residuals)
    return not any(
        len(part) and np.sqrt(np.mean(part**2)) > level
        for part, level in zip(parts, most.tolist(), strict=True)
    )


def _grow(fitter: Fitter, start: FitStart, count: int) -> list[FittedModel | None]:
    """Fit several starts to increasing parts of the records, and at last to the full records."""
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
    """The user's start, and points of a Sobol sequence around it in the shared unknowns."""
    from scipy.stats import qmc  # slow to import, and needed only if a fit misses the noise

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
    """Return fits at different points; of fits at the same point, only the best."""
    kept: list[FittedModel] = []
    for fit in fits:
        sizes = longest_step(fit.space, fit.x, DECLARED_MODEL.distinct)
        if all(np.any(np.abs(fit.x - other.x) > sizes) for other in kept):
            kept.append(fit)
    return kept
