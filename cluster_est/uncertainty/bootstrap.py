"""Bootstrap over experiments: intervals without assumptions on the residuals.

The experiments are drawn with replacement, as many as there are, and all values are estimated
again, starting from the optimum. The scatter of the shared estimates approximates that between
series of experiments. It allows for any correlation of residuals within an experiment (A. C.
Davison, D. V. Hinkley, Bootstrap Methods and their Application (1997),
doi:10.1017/CBO9780511802843, chapters 2 and 5).

Use it if residuals are not white, or if experiments differ by more than their noise. Do not use it
with few experiments, because there are too few different draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr, stdtrit

from cluster_est.errors import ProblemError
from cluster_est.methods.method import Ending, Method, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty.covariance.normal_equations import is_shared
from cluster_est.uncertainty.spaces import resampled
from cluster_est.uncertainty.uncertainty_settings import UncertaintySettings
from workers.messages import FloatArray
from workers.messages.types import by_content

LEAST_EXPERIMENTS = 5
LEAST_DRAWS = 20
"""Least number of usable draws for an interval."""


@dataclass(frozen=True)
class BootstrapDraw:
    """One draw: its experiments, their cost, the ending of the refit, and the shared estimates.

    An estimate is NaN if no drawn experiment depends on it, or if the refit failed.
    """

    experiments: tuple[str, ...]
    cost: float
    ending: str
    estimates: tuple[float, ...]


@dataclass(frozen=True)
class BootstrapInterval:
    """The interval of one shared unknown, in physical units; NaN if too few draws are usable.

    Attributes
    ----------
    label, value, std_error
        Label of the unknown, its estimate, and the standard deviation of the draws.
    lower, upper
        Expanded percentiles of the draws, which are also accurate for few experiments (T. C.
        Hesterberg, The American Statistician 69 (2015) 371-386). This is the interval to report.
    percentile_lower, percentile_upper
        Plain percentiles; too narrow for fewer than about 30 experiments.
    basic_lower, basic_upper
        Plain percentiles mirrored at the estimate. If they differ much from the percentiles, the
        estimate is biased, or its scatter depends on its value.
    used
        Number of usable draws.
    """

    label: str
    value: float
    std_error: float
    lower: float
    upper: float
    percentile_lower: float
    percentile_upper: float
    basic_lower: float
    basic_upper: float
    used: int


@by_content
@dataclass(frozen=True)
class BootstrapResult:
    """The result of resampling the experiments.

    Attributes
    ----------
    intervals
        Intervals of the shared unknowns; `labels` are their labels.
    draws
        Draws in their order.
    failures
        Number of draws that are not used because their refit failed.
    unfinished
        Number of draws whose refit stopped early, for example at a limit of iterations. They are
        used.
    confidence
        Confidence of the intervals.
    """

    labels: tuple[str, ...]
    intervals: tuple[BootstrapInterval, ...]
    draws: tuple[BootstrapDraw, ...] = field(repr=False)
    failures: int
    unfinished: int
    confidence: float

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on unused draws, on refits that stopped early, and on missing intervals."""
        count, found = len(self.draws), []
        if self.failures:
            found.append(
                f"bootstrap: {self.failures} of {count} draws are not used, because their refits "
                "failed or were stopped; the intervals come from the other draws"
            )
        if self.unfinished:
            found.append(
                f"bootstrap: the refits of {self.unfinished} of {count} draws stopped before they "
                "converged; these draws are used"
            )
        silent = [each.label for each in self.intervals if each.used < LEAST_DRAWS]
        if silent:
            found.append(
                f"bootstrap: there is no interval for {', '.join(silent)}, because fewer than "
                f"{LEAST_DRAWS} draws include it"
            )
        return tuple(found)


def bootstrap(
    runner: Runner,
    space: SearchSpace,
    solution: Solution,
    method: Method,
    settings: UncertaintySettings,
    generator: np.random.Generator,
) -> BootstrapResult:
    """Draw experiments, refit, and return the scatter of the shared estimates.

    The runner does not repeat simulations that it has already done.

    Parameters
    ----------
    runner
        Runs the refits.
    space, solution
        The search space, and the optimum.
    method
        Method of the refits; a local method, because refits start at the optimum.
    settings
        The number of draws, and the confidence.
    generator
        Generates the draws.

    Raises
    ------
    ProblemError
        If there are fewer than five experiments.
    """
    check_bootstrap(space)
    count, draws = len(space.experiments), range(settings.bootstrap)
    drawn = [np.sort(generator.integers(0, count, count)).tolist() for _ in draws]
    spaces = [resampled(space, positions, solution.x) for positions in drawn]
    seeds = generator.integers(0, 2**32, settings.bootstrap).tolist()
    requests = [
        SearchRequest(f"bootstrap {number}", method, each, seed)
        for number, (each, seed) in enumerate(zip(spaces, seeds, strict=True))
    ]
    found = runner.run(requests, settings.at_once)
    refits = [_draw(each, one, space) for each, one in zip(spaces, found, strict=True)]
    return BootstrapResult(
        labels=_shared_labels(space),
        intervals=_intervals(space, solution.x, refits, settings.confidence),
        draws=tuple(refits),
        failures=sum(not _is_valid(one) for one in found),
        unfinished=sum(_is_valid(one) and not one.ending.success for one in found),
        confidence=settings.confidence,
    )


def _shared_labels(space: SearchSpace) -> tuple[str, ...]:
    return tuple(space.unknowns[i].label for i in np.flatnonzero(is_shared(space)))


def _intervals(
    space: SearchSpace, x: FloatArray, draws: Sequence[BootstrapDraw], confidence: float
) -> tuple[BootstrapInterval, ...]:
    """Return the intervals of the shared unknowns."""
    labels, estimates, count = _shared_labels(space), space.estimates(x), len(space.experiments)
    table = np.array([draw.estimates for draw in draws]).reshape(len(draws), len(labels))
    return tuple(
        percentile_interval(label, estimates[label], table[:, j], count, confidence)
        for j, label in enumerate(labels)
    )


def check_bootstrap(space: SearchSpace) -> None:
    """Refuse a bootstrap over too few experiments.

    Raises
    ------
    ProblemError
        If there are fewer than five experiments, or priors, because draws do not vary priors.
    """
    named = next((u.label for u in space.unknowns if u.prior is not None), "")
    if named:
        raise ProblemError(
            f"uncertainty.bootstrap: must be 0 with priors, but {named} has one; this prior would "
            "be the same in every draw, so the intervals would be too narrow; use "
            "uncertainty.profiles instead"
        )
    count = len(set(space.experiments))
    if count < LEAST_EXPERIMENTS:
        raise ProblemError(
            f"uncertainty.bootstrap: needs at least {LEAST_EXPERIMENTS} training experiments to "
            f"draw from, but has {count}; use uncertainty.profiles instead"
        )


def _is_valid(solution: Solution) -> bool:
    bad = (Ending.START_FAILED, Ending.INFEASIBLE, Ending.BUDGET, Ending.INTERRUPTED)
    infeasible = solution.at is not None and not solution.at.feasible
    return bool(np.isfinite(solution.cost)) and solution.ending not in bad and not infeasible


def _draw(resample: SearchSpace, solution: Solution, space: SearchSpace) -> BootstrapDraw:
    """Return the refit of a resample, with the estimates of the shared unknowns."""
    estimates = resample.estimates(solution.x) if _is_valid(solution) else {}
    return BootstrapDraw(
        experiments=tuple(resample.problem.experiments[e].id for e in resample.experiments),
        cost=solution.cost,
        ending=solution.ending.name.lower(),
        estimates=tuple(estimates.get(label, np.nan) for label in _shared_labels(space)),
    )


def percentile_interval(
    label: str, value: float, draws: FloatArray, experiments: int, confidence: float
) -> BootstrapInterval:
    """Return the intervals of one unknown from draws with this number of experiments each."""
    draws = draws[np.isfinite(draws)]
    used = len(draws)
    if used < LEAST_DRAWS:
        none = np.nan
        return BootstrapInterval(label, value, none, none, none, none, none, none, none, used)
    tail = (1.0 - confidence) / 2.0
    # percentiles correspond to a normal quantile instead of a t quantile, and the variance of draws
    # is too small by (n - 1) / n; quantiles further out correct both
    quantile = stdtrit(experiments - 1, tail) * np.sqrt(experiments / (experiments - 1.0))
    outer = float(ndtr(quantile))
    low, high = np.quantile(draws, [tail, 1.0 - tail]).tolist()
    lower, upper = np.quantile(draws, [outer, 1.0 - outer]).tolist()
    return BootstrapInterval(
        label,
        value,
        std_error=float(np.std(draws, ddof=1)),
        lower=lower,
        upper=upper,
        percentile_lower=low,
        percentile_upper=high,
        basic_lower=2.0 * value - high,
        basic_upper=2.0 * value - low,
        used=used,
    )
