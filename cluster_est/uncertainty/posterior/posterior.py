"""The recipe: place walkers around an optimum, move them, judge the chains, and sum them up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.methods.base import Ending, Solution
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.scaled_inverse import root_of_inverse
from cluster_est.uncertainty.covariance.result import ConfidenceInterval
from cluster_est.uncertainty.posterior.density import check_posterior
from cluster_est.uncertainty.posterior.diagnostics import (
    autocorrelation_times,
    split_shrink_factors,
)
from cluster_est.uncertainty.posterior.ensemble import EnsembleSampling, WalkerChain
from cluster_est.uncertainty.posterior.result import (
    PosteriorInterval,
    PosteriorResult,
    central,
    is_mixed,
)
from cluster_est.uncertainty.settings import UncertaintySettings
from workers.messages import FloatArray

LEAST_WALKERS = 16
PER_UNKNOWN = 4
"""Walkers; twice the number of unknowns is the least with which differences span all directions."""
FORGOTTEN = 10.0
"""Autocorrelation times after which a walker has forgotten its start."""
MOST_DISCARDED = 0.5
"""Of the steps."""
WIDEST = 0.25
"""Of the range between the bounds: as wide as nearly uniform walkers are."""
APART = 2.0
"""Standard deviations of the likelihood as which walkers begin."""
SPREAD = 0.1
"""Of a typical size, where no standard error is known."""


def sample_posterior(
    runner: Runner,
    space: SearchSpace,
    solution: Solution,
    intervals: Sequence[ConfidenceInterval],
    settings: UncertaintySettings,
    generator: np.random.Generator,
) -> PosteriorResult:
    """Draw from the posterior of all unknowns of a space.

    Parameters
    ----------
    runner
        For the simulations: half of the walkers at a time.
    space, solution
        The space that was searched, and the optimum, around which the walkers begin.
    intervals
        Of the unknowns, from derivatives: how far around.
    settings
        Steps, walkers and confidence.
    generator
        The source of all chance.
    """
    check_posterior(space, settings.walkers)
    count = settings.walkers or max(LEAST_WALKERS, PER_UNKNOWN * space.size)
    chain = WalkerChain()
    starts = _starts(space, solution, intervals, count, generator)
    method = EnsembleSampling(starts, settings.posterior, chain)
    seed = int(generator.integers(2**32))
    (solved,) = runner.run([SearchRequest("posterior", method, space, seed)])
    if solved.ending is Ending.START_FAILED:
        why = f"none of {count} walkers began at a point with a density"
        return _nothing(space, chain, settings, why)
    if len(chain.states) < settings.posterior:
        done = f"{len(chain.states):,} of {settings.posterior:,} steps"
        return _nothing(space, chain, settings, f"it was cut short after {done}")
    if not np.isfinite(chain.densities[-1]).all():
        lost = int((~np.isfinite(chain.densities[-1])).sum())
        return _nothing(
            space, chain, settings, f"{lost} of {count} walkers found no point with a density"
        )
    return _summed_up(space, solution, chain, settings)


def _nothing(
    space: SearchSpace, chain: WalkerChain, settings: UncertaintySettings, why: str
) -> PosteriorResult:
    return PosteriorResult(
        labels=tuple(unknown.label for unknown in space.unknowns),
        values=np.zeros((0, 0, space.size)),
        log_densities=np.zeros((0, 0)),
        intervals=(),
        confidence=settings.confidence,
        steps=len(chain.states),
        discarded=0,
        failures=chain.failures,
        asked=chain.asked,
        why_not=why,
    )


def _starts(
    space: SearchSpace,
    solution: Solution,
    intervals: Sequence[ConfidenceInterval],
    count: int,
    generator: np.random.Generator,
) -> FloatArray:
    """(walkers, unknowns): normal around the optimum, within the bounds.

    With the covariance of the likelihood, where its derivatives are known: walkers that ignore how
    unknowns make up for each other begin far from where the density is, and may stay there.
    """
    x = solution.x
    values = np.array(list(space.estimates(x).values()))
    errors = np.array([each.std_error for each in intervals])
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.where(space.logarithmic, errors / values, errors)
    known = np.isfinite(errors) & (errors > 0.0)
    ranges = np.where(np.isfinite(space.upper - space.lower), space.upper - space.lower, np.inf)
    sizes = np.where(known, errors, SPREAD * np.minimum(space.typical, ranges))
    sizes = np.minimum(sizes, WIDEST * ranges)
    normal = generator.normal(size=(count, space.size))
    if solution.jacobian is None or not np.isfinite(solution.jacobian).all():
        return _folded(x + sizes * normal, space.lower, space.upper)
    tall = solution.jacobian / APART
    root = root_of_inverse(tall.T @ tall + np.diag(1.0 / sizes**2))
    drawn = x + normal @ root.T
    return _folded(drawn, space.lower, space.upper)


def _folded(points: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Points beyond a bound, folded back as often as it takes: no two walkers on one bound."""
    both = np.isfinite(lower) & np.isfinite(upper)
    width = np.where(both, upper - lower, 1.0)
    from_lower = np.where(both, points - lower, 0.0) % (2.0 * width)
    folded = lower + np.minimum(from_lower, 2.0 * width - from_lower)
    one = np.where(points < lower, 2.0 * lower - points, points)
    one = np.where(one > upper, 2.0 * upper - one, one)
    return np.asarray(np.clip(np.where(both, folded, one), lower, upper))


def _summed_up(
    space: SearchSpace, solution: Solution, chain: WalkerChain, settings: UncertaintySettings
) -> PosteriorResult:
    """Leave out the first steps, judge the others, and take their quantiles."""
    states, densities = np.array(chain.states), np.array(chain.densities)
    most = int(MOST_DISCARDED * len(states))
    slowest = float(autocorrelation_times(states[most:]).max(initial=1.0))
    discarded = min(most, int(FORGOTTEN * slowest)) if np.isfinite(slowest) else most
    kept, densities = states[discarded:], densities[discarded:]
    values = kept.copy()
    for i, unknown in enumerate(space.unknowns):
        if unknown.log:
            values[:, :, i] = np.clip(np.exp(kept[:, :, i]), unknown.parameter.lower,
                                      unknown.parameter.upper)  # fmt: skip
    found = _intervals(space, solution, kept, values, settings.confidence)
    return PosteriorResult(
        labels=tuple(unknown.label for unknown in space.unknowns),
        values=values,
        log_densities=densities,
        intervals=found,
        confidence=settings.confidence,
        steps=len(states),
        discarded=discarded,
        failures=chain.failures,
        asked=chain.asked,
    )


def _intervals(
    space: SearchSpace,
    solution: Solution,
    kept: FloatArray,
    values: FloatArray,
    confidence: float,
) -> tuple[PosteriorInterval, ...]:
    """The central intervals; without numbers where the chains have not mixed."""
    times, factors = autocorrelation_times(kept), split_shrink_factors(kept)
    estimates, draws = space.estimates(solution.x), kept.shape[0] * kept.shape[1]
    ends, found = central(confidence), []
    for i, unknown in enumerate(space.unknowns):
        own = values[:, :, i].ravel()
        low, middle, high = np.quantile(own, ends).tolist()
        found.append(
            PosteriorInterval(
                label=unknown.label,
                value=estimates[unknown.label],
                mean=float(own.mean()),
                std_error=float(own.std()),
                median=middle,
                lower=low,
                upper=high,
                autocorrelation_time=float(times[i]),
                shrink_factor=float(factors[i]),
                effective=draws / float(times[i]),
            )
        )
    if is_mixed(len(kept), tuple(found)):
        return tuple(found)
    return tuple(
        replace(each, mean=np.nan, std_error=np.nan, median=np.nan, lower=np.nan, upper=np.nan)
        for each in found
    )
