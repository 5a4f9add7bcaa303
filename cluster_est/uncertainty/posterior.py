"""The posterior of the unknowns: its density, draws from it, and tests of their convergence.

Walkers start around an optimum, and the package emcee moves them (D. Foreman-Mackey, D. W. Hogg, D.
Lang, J. Goodman, PASP 125 (2013) 306-312, doi:10.1086/670067). Half of the walkers move at a time,
along differences of two others, so that each request is a batch of simulations and no step size has
to be chosen (differential evolution: C. J. F. ter Braak, Stat. Comput. 16 (2006) 239-249,
doi:10.1007/s11222-006-8769-1). Then the chains are tested and summarised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.callback_bridge import Ask, search_in_thread
from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.compatibility import check_priors, need_sigmas, refuse_distances
from cluster_est.problem.costs import GaussianLikelihood, SumSquared
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import Unknown
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.projection import root_of_inverse
from cluster_est.toml import dotted
from cluster_est.uncertainty.covariance.local_uncertainty import ConfidenceInterval
from cluster_est.uncertainty.posterior_draws import (
    PosteriorInterval,
    PosteriorResult,
    central,
    is_mixed,
)
from cluster_est.uncertainty.uncertainty_settings import UncertaintySettings
from workers.messages import FloatArray


def log_density(space: SearchSpace, x: FloatArray, at: Evaluation) -> float:
    """Return ln p(x | measurements) in search coordinates, up to a constant.

    The likelihood is exp(-F / 2). F is the sum of squared residuals over sigma^2, or the F of the
    Gaussian likelihood with its estimated sigmas. An unknown without a prior is uniform between its
    bounds on its own scale; for a log scale, its logarithm is uniform.

    Parameters
    ----------
    space, x
        The search space, and the point.
    at
        The evaluation at the point.
    """
    if not at.feasible or not math.isfinite(at.cost):
        return -math.inf
    own = (_beside_the_cost(u, float(x[i])) for i, u in enumerate(space.unknowns) if u.prior)
    return -0.5 * at.cost + sum(own)


def _beside_the_cost(unknown: Unknown, searched: float) -> float:
    """Return the part of a prior's log density that is not in the cost as a squared residual."""
    value, prior = unknown.to_physical(searched), unknown.prior
    assert prior is not None
    change = math.log(value) if unknown.log and value > 0.0 else 0.0
    return prior.log_density(value) + 0.5 * prior.residual(value) ** 2 + change


LEAST_WALKERS = 8
"""Least number of walkers; only half of them are available for differences."""


def check_posterior(space: SearchSpace, walkers: int = 0) -> None:
    """Refuse a problem or a number of walkers with which no draws are possible.

    Parameters
    ----------
    space
        Search space of the unknowns.
    walkers
        Number of walkers; 0 for the number that the unknowns need.

    Raises
    ------
    ProblemError
        If the cost is not a likelihood, there are too few walkers, or emcee is not installed.
    """
    if find_spec("emcee") is None:
        raise ProblemError(
            "uncertainty.posterior: needs emcee, which is not installed; run pip install "
            "'cluster-est[posterior]', or use uncertainty.profiles"
        )
    problem, least = space.problem, max(LEAST_WALKERS, 2 * space.size)
    if walkers and walkers < least:
        raise ProblemError(
            f"uncertainty.walkers: must be at least {least} (twice the number of unknowns, and at "
            f"least {LEAST_WALKERS}), but is {walkers}; 0 uses as many as are needed"
        )
    if space.equality.any():
        name = space.constraint_names[int(np.argmax(space.equality))]
        raise ProblemError(
            f"uncertainty.posterior: no draw satisfies the equality {name!r} exactly; define one "
            "parameter by an expression in the others, or use uncertainty.profiles"
        )
    check_priors(problem)
    refuse_distances(problem, "uncertainty.posterior")
    if isinstance(problem.cost, SumSquared):
        need_sigmas(
            problem,
            "uncertainty.posterior needs the standard deviation of the noise to form a likelihood "
            '(or use cost.name = "likelihood", which estimates it)',
        )
    elif not isinstance(problem.cost, GaussianLikelihood):
        raise ProblemError(
            'uncertainty.posterior: must be used with the cost "sse" or "likelihood", which are '
            f"likelihoods, but cost.name is {problem.cost.name!r}; change one of the two"
        )
    for unknown, low, high in zip(space.unknowns, space.lower, space.upper, strict=True):
        if unknown.prior is None and not np.isfinite([low, high]).all():
            parameter = unknown.parameter
            raise ProblemError(
                f"{dotted('parameters', parameter.name)}: must have finite bounds or a prior for "
                f"uncertainty.posterior, but has no prior and the bounds [{parameter.lower:g}, "
                f"{parameter.upper:g}] on a {parameter.scale} scale; add finite bounds or a prior"
            )


def autocorrelation_times(chain: FloatArray) -> FloatArray:
    """Return the integrated autocorrelation time of each unknown, in steps.

    The mean over n steps of w walkers is as accurate as the mean of w n / time independent draws
    (A. Sokal, in C. DeWitt-Morette et al., Functional Integration (1997),
    doi:10.1007/978-1-4899-0319-8_6).

    Parameters
    ----------
    chain : (steps, walkers, unknowns)

    Returns
    -------
    (unknowns,)
        At least 1; infinite for an unknown that did not change in some walker.
    """
    from emcee.autocorr import integrated_time  # only a posterior needs it

    moves = (np.ptp(chain, axis=0) > 0.0).all(axis=0)
    times = np.full(chain.shape[2], np.inf)
    if moves.any() and len(chain) > 1:
        times[moves] = integrated_time(chain[:, :, moves], tol=0, quiet=True)
    return np.where(np.isnan(times), np.inf, np.maximum(times, 1.0))


def split_shrink_factors(chain: FloatArray) -> FloatArray:
    """Return the potential scale reduction of split chains (split R-hat) for each unknown.

    It is sqrt(((n - 1) / n W + B / n) / W), where W is the mean variance within the halves of all
    walkers, and B / n the variance of their means (A. Gelman, D. B. Rubin, Stat. Sci. 7 (1992)
    457-472, doi:10.1214/ss/1177011136; A. Vehtari et al., Bayesian Anal. 16 (2021) 667-718,
    doi:10.1214/20-BA1221). It is 1 if all chains have the same distribution.

    Parameters
    ----------
    chain : (steps, walkers, unknowns)

    Returns
    -------
    (unknowns,)
        Infinite for an unknown that never changed.
    """
    half = len(chain) // 2
    if half < 2:
        return np.full(chain.shape[2], np.inf)
    parts = np.concatenate([chain[:half], chain[len(chain) - half :]], axis=1)
    within = parts.var(axis=0, ddof=1).mean(axis=0)
    between = parts.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = np.sqrt(((half - 1) / half * within + between) / within)
    return np.where(np.isnan(factors), np.inf, factors)


WHOLE_DIFFERENCES = 0.1
"""Share of the moves with a factor of 1 on the difference; they can jump between modes (ter
Braak)."""


@dataclass
class WalkerChain:
    """The positions of all walkers after each step, in search coordinates."""

    states: list[FloatArray] = field(default_factory=list)
    densities: list[FloatArray] = field(default_factory=list)
    failures: int = 0
    asked: int = 0

    def add(self, states: FloatArray, densities: FloatArray) -> None:
        self.states.append(states.copy())
        self.densities.append(densities.copy())


@dataclass(frozen=True, eq=False)
class EnsembleSampling(Method):
    """Moves walkers, and stores their positions.

    Attributes
    ----------
    starts : (walkers, unknowns)
        Start points in search coordinates, within the bounds.
    steps
        Number of steps of each walker.
    chain
        Receives the draws; if the search is interrupted, it contains the draws so far.
    """

    name: ClassVar[str] = "posterior"
    needs_residuals: ClassVar[bool] = False
    needs_every_residual: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    starts: FloatArray
    steps: int
    chain: WalkerChain

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        return search_in_thread(lambda ask: self._draw(space, ask, generator))

    def _draw(self, space: SearchSpace, ask: Ask, generator: np.random.Generator) -> Solution:
        import emcee  # only a posterior needs it

        density = _Density(space, ask, self.chain)
        moves = [
            (emcee.moves.DEMove(), 1.0 - WHOLE_DIFFERENCES),
            (emcee.moves.DEMove(gamma0=1.0), WHOLE_DIFFERENCES),
        ]
        sampler = emcee.EnsembleSampler(
            len(self.starts), space.size, density, vectorize=True, moves=moves
        )
        seed = int(generator.integers(2**32))
        sampler.random_state = np.random.RandomState(seed).get_state()
        steps = sampler.sample(
            self.starts, iterations=self.steps, store=False, skip_initial_state_check=True
        )
        try:
            with np.errstate(invalid="ignore"):  # a move between two points with zero density
                for state in steps:
                    self.chain.add(state.coords, state.log_prob)
                    density.progress = Progress(len(self.chain.states), density.best_cost)
        except _NoDensityError:
            return Solution(
                space.start, np.nan, Ending.START_FAILED, "no walker has a finite density"
            )
        best = density.best
        assert best is not None
        return Solution(best[0], best[1].cost, Ending.CONVERGED, iterations=self.steps, at=best[1])


class _NoDensityError(Exception):
    """All walkers start at points with zero density, so they could not move."""


class _Density:
    """The log density of many points at once, which the sampler calls."""

    def __init__(self, space: SearchSpace, ask: Ask, chain: WalkerChain) -> None:
        self._space, self._ask, self._chain = space, ask, chain
        self.progress = Progress(0, np.nan)
        self.best: tuple[FloatArray, Evaluation] | None = None
        self._begun = False

    @property
    def best_cost(self) -> float:
        return np.nan if self.best is None else self.best[1].cost

    def __call__(self, points: FloatArray) -> FloatArray:
        space = self._space
        found = np.full(len(points), -np.inf)
        inside = ((points >= space.lower) & (points <= space.upper)).all(axis=1)
        if not inside.any() and self._begun:
            return found
        asked = points[inside]
        answers = self._ask(Points(asked.copy(), "posterior", self.progress))
        self._chain.asked += len(answers)
        self._chain.failures += sum(not at.ok for at in answers)
        found[inside] = [log_density(space, x, at) for x, at in zip(asked, answers, strict=True)]
        for x, at in zip(asked, answers, strict=True):
            if at.ok and (self.best is None or at.rank < self.best[1].rank):
                self.best = x.copy(), at
        if not self._begun and not np.isfinite(found).any():
            raise _NoDensityError
        self._begun = True
        return found


USUAL_WALKERS = 16
PER_UNKNOWN = 4
"""Walkers per unknown; at least 2 are needed so that differences span all directions."""
FORGOTTEN = 10.0
"""Number of autocorrelation times after which a walker is independent of its start."""
MOST_DISCARDED = 0.5
"""Largest share of the steps that is discarded."""
WIDEST = 0.25
"""Largest standard deviation of the first walkers, over the distance of the bounds; the walkers are
then nearly uniform."""
INITIAL_WALKER_SPREAD = 2.0
"""Standard deviation of the first walkers, over that of the likelihood."""
SPREAD = 0.1
"""Spread of the first walkers without a standard error, over the typical size of an unknown."""


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
        Runs the simulations, for half of the walkers at a time.
    space, solution
        The search space, and the optimum, around which the walkers start.
    intervals
        Intervals of the unknowns from derivatives; they give the spread of the start points.
    settings
        Steps, walkers and confidence.
    generator
        Generates all random numbers.
    """
    check_posterior(space, settings.walkers)
    count = settings.walkers or max(USUAL_WALKERS, PER_UNKNOWN * space.size)
    chain = WalkerChain()
    starts = _starts(space, solution, intervals, count, generator)
    method = EnsembleSampling(starts, settings.posterior, chain)
    seed = int(generator.integers(2**32))
    (solved,) = runner.run([SearchRequest("posterior", method, space, seed)])
    if solved.ending is Ending.START_FAILED:
        why = f"none of the {count} walkers began at a point with a finite density"
        return _without_draws(space, chain, settings, why)
    if len(chain.states) < settings.posterior:
        done = f"{len(chain.states):,} of {settings.posterior:,} steps"
        return _without_draws(space, chain, settings, f"sampling was stopped after {done}")
    if not np.isfinite(chain.densities[-1]).all():
        lost = int((~np.isfinite(chain.densities[-1])).sum())
        return _without_draws(
            space,
            chain,
            settings,
            f"{lost} of {count} walkers found no point with a finite density",
        )
    return _summed_up(space, solution, chain, settings)


def _without_draws(
    space: SearchSpace, chain: WalkerChain, settings: UncertaintySettings, why: str = ""
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
    """Return normally distributed start points around the optimum: (walkers, unknowns).

    They have the covariance of the likelihood, if its derivatives are known. Without the
    correlations, walkers may start, and stay, where the density is very small.
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
    tall = solution.jacobian / INITIAL_WALKER_SPREAD
    root = root_of_inverse(tall.T @ tall + np.diag(1.0 / sizes**2))
    drawn = x + normal @ root.T
    return _folded(drawn, space.lower, space.upper)


def _folded(points: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Reflect points at the bounds until they lie inside, so that none lies on a bound."""
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
    """Discard the first steps, test the convergence of the others, and compute their quantiles."""
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
    return replace(
        _without_draws(space, chain, settings),
        values=values,
        log_densities=densities,
        intervals=_intervals(space, solution, kept, values, settings.confidence),
        discarded=discarded,
    )


def _intervals(
    space: SearchSpace,
    solution: Solution,
    kept: FloatArray,
    values: FloatArray,
    confidence: float,
) -> tuple[PosteriorInterval, ...]:
    """Return the central intervals; they are NaN if the chains have not mixed."""
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
