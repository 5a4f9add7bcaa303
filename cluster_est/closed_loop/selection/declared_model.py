"""Fit the declared model so that a local minimum is not mistaken for a missing effect.

If the fit from the user's start does not reach the noise, other starts grow through longer and
longer parts of every record: on a short part the cost has few minima, and what is found there lies
near the right one on a longer part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.measured_noise import noise_of
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.synthetic_experiments import shortened_kinds
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.sensors import unstarted_sensors
from workers.messages import FloatArray

THOROUGH = LeastSquares(trials=1, max_iterations=25, ftol=1e-7, xtol=1e-8, differences="forward")
BRIEF = LeastSquares(trials=1, max_iterations=8, ftol=1e-4, xtol=1e-5, differences="forward")


def fit_declared(workbench: LoopWorkbench, start: FitStart) -> FittedModel:
    """Fit from the user's start, and from others unless that reaches the noise.

    With process noise it is the one start: a filter follows what is measured from wherever it
    stands, so that there is no growing along a record.

    Raises
    ------
    ProblemError
        If the model cannot be simulated at its start.
    """
    first = workbench.first_fit if not start.values else None
    if first is None:
        (first,) = workbench.fit(LoopStage.DECLARED_MODEL, [start], THOROUGH)
    if first is not None and (workbench.filtered or at_noise(workbench, first)):
        return first
    grown = _grow(workbench, start)
    best = [f for f in (first, *grown) if f is not None]
    if not best:
        raise ProblemError(
            "closed loop: the declared model cannot be simulated from its start values; try "
            "cluster-est check, and other start values"
        )
    return min(best, key=lambda fitted: fitted.sse)


def at_noise(workbench: LoopWorkbench, fitted: FittedModel) -> bool:
    """Return whether the residual is as small as its own roughness says it can be."""
    noise = noise_of(workbench, fitted.residuals)
    for output, sigma in enumerate(noise.tolist()):
        part = fitted.residuals[workbench.records.of_output(output)]
        if (
            len(part)
            and np.sqrt(np.mean(part**2)) > workbench.thresholds.declared_model.at_noise * sigma
        ):
            return False
    return True


def _grow(workbench: LoopWorkbench, start: FitStart) -> list[FittedModel | None]:
    """Several starts through the horizons to the full records."""
    starts = _spread(workbench, start)
    thresholds = workbench.thresholds.declared_model
    horizons = shortened_kinds(workbench.thresholds.preparation)
    for horizon, survivors in zip(horizons, thresholds.survivors, strict=True):
        fits = workbench.fit(LoopStage.DECLARED_MODEL, starts, BRIEF, horizon)
        alive = sorted((f for f in fits if f is not None), key=lambda f: f.sse)
        starts = [
            FitStart(start.problem, workbench.measured_estimates(f, horizon), start.added)
            for f in _distinct(alive, thresholds.distinct)[:survivors]
        ]
    return workbench.fit(LoopStage.DECLARED_MODEL, starts, THOROUGH)


def _spread(workbench: LoopWorkbench, start: FitStart) -> list[FitStart]:
    """The user's start, and points of a Sobol sequence around it for the shared values."""
    from scipy.stats import qmc  # slow to import, and only a fit that misses the noise asks for it

    space = workbench.space(start)
    sensors = {i for sensor in unstarted_sensors(space) for i in sensor.unknowns}
    shared = [i for i, u in enumerate(space.unknowns) if not u.scope and i not in sensors]
    sampler = qmc.Sobol(max(1, len(shared)), rng=workbench.generator(1))
    count = workbench.settings.starts
    cube = 2.0 * sampler.random(1 << (count - 1).bit_length())[:count] - 1.0
    cube[0] = 0.0
    spread = workbench.thresholds.declared_model.spread
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
