"""Fit the declared model so that a local minimum is not mistaken for a missing effect.

If the fit from the user's start does not reach the noise, other starts grow through longer and
longer parts of every record: on a short part the cost has few minima, and what is found there lies
near the right one on a longer part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import qmc

from cluster_est.closed_loop.statistics.noise import estimate_noise
from cluster_est.closed_loop.workbench import HORIZONS, FitStart, FittedModel, LoopWorkbench
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

AT_NOISE = 1.05
"""Residual over noise below which nothing better is looked for."""
SPREAD = 0.35
"""Of the starts: in logarithms, or as a share of a value."""
SURVIVORS = (4, 2)
"""How many starts go on after each horizon."""

THOROUGH = LeastSquares(trials=2, max_iterations=25, ftol=1e-7, xtol=1e-8, differences="forward")
BRIEF = LeastSquares(trials=2, max_iterations=8, ftol=1e-4, xtol=1e-5, differences="forward")


def fit_declared(bench: LoopWorkbench, start: FitStart) -> FittedModel:
    """Fit from the user's start, and from others unless that reaches the noise.

    Raises
    ------
    ProblemError
        If the model cannot be simulated at its start.
    """
    (first,) = bench.fit("base", [start], THOROUGH)
    if first is not None and at_noise(bench, first):
        return first
    grown = _grow(bench, start)
    best = [f for f in (first, *grown) if f is not None]
    if not best:
        raise ProblemError(
            "closed loop: the declared model cannot be simulated from its start values; try "
            "cluster-est check, and other start values"
        )
    return min(best, key=lambda fitted: fitted.sse)


def at_noise(bench: LoopWorkbench, fitted: FittedModel) -> bool:
    """Whether the residual is as small as its own roughness says it can be."""
    noise = estimate_noise(fitted.residuals, bench.records)
    for output, sigma in enumerate(noise.tolist()):
        part = fitted.residuals[bench.records.of_output(output)]
        if len(part) and np.sqrt(np.mean(part**2)) > AT_NOISE * sigma:
            return False
    return True


def _grow(bench: LoopWorkbench, start: FitStart) -> list[FittedModel | None]:
    """Several starts through the horizons to the full records."""
    starts = _spread(bench, start)
    for horizon, survivors in zip(HORIZONS, SURVIVORS, strict=True):
        fits = bench.fit("base", starts, BRIEF, rehearsal=f"{horizon:.0%}")
        alive = sorted((f for f in fits if f is not None), key=lambda f: f.sse)
        starts = [
            FitStart(start.problem, _own_labels(bench, f, f"{horizon:.0%}"), start.added)
            for f in _distinct(alive)[:survivors]
        ]
    return bench.fit("base", starts, THOROUGH)


def _spread(bench: LoopWorkbench, start: FitStart) -> list[FitStart]:
    """The user's start, and points of a Sobol sequence around it for the shared values."""
    space = bench.space(start)
    shared = [i for i, unknown in enumerate(space.unknowns) if "[" not in unknown.label]
    sampler = qmc.Sobol(max(1, len(shared)), rng=bench.generator(1))
    count = bench.settings.starts
    cube = 2.0 * sampler.random(1 << (count - 1).bit_length())[:count] - 1.0
    cube[0] = 0.0
    return [
        FitStart(start.problem, space.estimates(_moved(space, shared, row)), start.added)
        for row in cube
    ]


def _moved(space: SearchSpace, shared: Sequence[int], row: FloatArray) -> FloatArray:
    x = space.start.copy()
    for i, way in zip(shared, row.tolist(), strict=False):
        x[i] += SPREAD * way * (1.0 if space.unknowns[i].log else space.typical[i])
    return np.asarray(np.clip(x, space.lower, space.upper))


def _distinct(fits: Sequence[FittedModel]) -> list[FittedModel]:
    """Fits at different points, the best of each."""
    kept: list[FittedModel] = []
    for fit in fits:
        log = np.array([unknown.log for unknown in fit.space.unknowns], bool)
        sizes = np.where(log, 1.0, np.maximum(np.abs(fit.x), fit.space.typical))
        if all(np.abs((fit.x - other.x) / sizes).max() > 1e-2 for other in kept):
            kept.append(fit)
    return kept


def _own_labels(bench: LoopWorkbench, fitted: FittedModel, rehearsal: str) -> dict[str, float]:
    """Estimates with the labels of the experiments themselves instead of their rehearsals'."""
    experiments = bench.everything.experiments
    names = {
        experiments[copy].id: experiments[own].id
        for own, copy in zip(bench.train, bench.rehearsals[rehearsal], strict=True)
    }
    values = {}
    for label, value in fitted.estimates.items():
        name, _, scope = label.partition("[")
        scope = scope.removesuffix("]")
        values[f"{name}[{names.get(scope, scope)}]" if scope else name] = value
    return values
