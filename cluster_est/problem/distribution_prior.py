"""Priors from frozen distributions of SciPy, such as `scipy.stats.gamma(2.0, scale=0.5)`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.problem.priors import LogNormalPrior, NormalPrior, Prior
from workers.messages.checks import shown, told_apart

QUANTILES = np.linspace(0.0, 1.0, 2002)[1:-1]
"""Quantiles of the distribution, between which its mode is searched for."""
DERIVATIVE_STEP = 1e-4
"""Step of finite differences of ln p, over the distance between the quartiles."""
FARTHEST = 1e3
"""Residual if the density is 0, because a search needs a finite residual."""


@dataclass(frozen=True)
class DistributionPrior(Prior):
    """A prior with the density p of a continuous distribution that has one mode.

    residual = sign(x - mode) sqrt(2 ln(p(mode) / p(x))). Half of its square is -ln p plus a
    constant, so the estimate is the most probable value. For a normal p, the residual is that of
    `NormalPrior`.

    Attributes
    ----------
    distribution
        A frozen distribution of `scipy.stats`.
    """

    name: ClassVar[str] = "distribution"

    distribution: Any

    def __post_init__(self) -> None:
        low, high = (float(end) for end in self.distribution.support())
        peak = self._log(self.centre)
        ends = [self._log(end) for end in (low, high) if math.isfinite(end)]
        edge = not math.isfinite(peak) or self._spread <= 0.0 or any(e >= peak for e in ends)
        if edge or not 0.5 < self._bend(0.1) / self._bend(1.0) < 2.0:
            raise ProblemError(
                "prior: must have a density with one smooth mode that is not at an end of its "
                f"range, but {self.said()} has no such mode; for a uniform distribution, give only "
                "bounds, as in bounds=(0.1, 10.0)"
            )

    def _log(self, value: float) -> float:
        with np.errstate(all="ignore"):
            return float(self.distribution.logpdf(value))

    def _bend(self, steps: float) -> float:
        """Return minus the second derivative of ln p at the mode; infinite or NaN if undefined."""
        step = steps * DERIVATIVE_STEP * self._spread
        sides = self._log(self.centre + step) + self._log(self.centre - step)
        return max(2.0 * self._log(self.centre) - sides, 1e-300) / step**2

    @cached_property
    def _spread(self) -> float:
        """The distance between the quartiles."""
        low, high = self.distribution.ppf([0.25, 0.75])
        return float(high - low)

    @cached_property
    @override
    def centre(self) -> float:
        from scipy.optimize import minimize_scalar

        places = self.distribution.ppf(QUANTILES)
        with np.errstate(all="ignore"):
            best = int(np.argmax(self.distribution.logpdf(places)))
        around = places[max(best - 1, 0)], places[min(best + 1, len(places) - 1)]
        options = {"xatol": 1e-12 * max(abs(around[0]), abs(around[1]), 1e-300)}
        found = minimize_scalar(
            lambda x: -self._log(x), bounds=around, method="bounded", options=options
        )
        return float(found.x)

    @override
    def residual(self, value: float) -> float:
        rise = self._log(self.centre) - self._log(value)
        size = math.sqrt(2.0 * max(rise, 0.0)) if math.isfinite(rise) else FARTHEST
        return math.copysign(min(size, FARTHEST), value - self.centre)

    @override
    def slope(self, value: float) -> float:
        step = DERIVATIVE_STEP * self._spread
        residual = self.residual(value)
        if abs(value - self.centre) > 10.0 * step and abs(residual) < FARTHEST:
            change = self._log(value + 0.1 * step) - self._log(value - 0.1 * step)
            slope = -change / (0.2 * step) / residual
            if math.isfinite(slope):
                return slope
        return math.sqrt(self._bend(1.0))

    @override
    def log_density(self, value: float) -> float:
        return max(self._log(value), -0.5 * FARTHEST**2)

    @override
    def said(self) -> str:
        given = [f"{each:g}" for each in self.distribution.args]
        given += [f"{key}={each:g}" for key, each in self.distribution.kwds.items()]
        return f"{self.distribution.dist.name}({', '.join(given)})"

    @override
    def check(self, where: str, start: float, lower: float, upper: float) -> None:
        super().check(where, start, lower, upper)
        low, high = (float(end) for end in self.distribution.support())
        if not low <= lower < upper <= high:
            first, last, least, most = told_apart(low, high, lower, upper)
            raise ProblemError(
                f"{where}.bounds: must lie where the prior {self.said()} has a density, which is "
                f"from {first} to {last}, but are [{least}, {most}]; narrow them"
            )


def as_prior(given: Any, where: str) -> Any:
    """Return a frozen distribution of SciPy as a prior; return anything else unchanged.

    A normal distribution gives a `NormalPrior`, and a log-normal distribution a `LogNormalPrior`,
    whose mode is that of the logarithm.

    Raises
    ------
    ProblemError
        If the distribution is discrete, or its density does not have exactly one mode.
    """
    kind = getattr(getattr(given, "dist", None), "name", None)
    if isinstance(given, Prior) or kind is None or not hasattr(given, "support"):
        return given
    if not hasattr(given.dist, "logpdf"):
        raise ProblemError(f"{where}: must be a continuous distribution, but is {shown(given)}")
    loc, scale = (float(each) for each in (given.ppf(0.5), given.std()))
    if kind == "norm":
        return NormalPrior(loc, scale)
    if kind == "lognorm" and given.support()[0] == 0.0:
        factor = float(given.ppf(_ONE_SIGMA)) / loc
        return LogNormalPrior(loc, factor)
    return DistributionPrior(given)


_ONE_SIGMA = 0.5 * (1.0 + math.erf(math.sqrt(0.5)))
"""Probability below one standard deviation above the mean of a normal distribution."""
