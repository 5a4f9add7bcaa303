"""One unknown: a bracket around a minimum, then `scipy.optimize.minimize_scalar` within it.

SciPy's bounded method is golden section with parabolas, of R. P. Brent, Algorithms for Minimization
without Derivatives, Prentice-Hall 1973.
"""

from __future__ import annotations

import numpy as np

from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.methods.callback_bridge import Ask, search_in_thread
from cluster_est.methods.coordinates import ScaledCoordinates
from cluster_est.methods.simplex.simplex import SimplexVertex
from cluster_est.problem.search_space.space import SearchSpace

LEAST_TOLERANCE = 1e-12
"""SciPy would not end without any."""


def minimise_scalar_unknown(
    space: SearchSpace, start: Evaluation, step: float, xtol: float, max_evaluations: int
) -> Search:
    """Search one unknown.

    Where both bounds are finite it searches all between them, as it is usual, and around the start
    only if that was better than all it found. Otherwise it goes downhill from the start, with
    steps that double, until the cost rises or a bound is met.

    Parameters
    ----------
    space
        With one unknown.
    start
        The evaluation at its start.
    step
        First step downhill, in noticeable changes.
    xtol
        Tolerance of the minimum, in noticeable changes.
    max_evaluations
        Limit, apart from a few.
    """
    line = _LineSearch(space, start, step, max(xtol, LEAST_TOLERANCE), max_evaluations)
    return search_in_thread(line.solve)


class _LineSearch:
    """The state of a search along one unknown: the best point and the evaluations that are left."""

    def __init__(
        self, space: SearchSpace, start: Evaluation, step: float, xtol: float, max_evaluations: int
    ) -> None:
        self._coordinates, self._step, self._xtol, self._left = (
            ScaledCoordinates(space),
            step,
            xtol,
            max_evaluations,
        )
        self._start = self._best = SimplexVertex(np.zeros(1), start)
        self._progress = Progress(0, start.cost)

    def solve(self, ask: Ask) -> Solution:
        lower, upper = float(self._coordinates.lower[0]), float(self._coordinates.upper[0])
        converged = False
        if np.isfinite(upper - lower):
            converged = self._between(ask, lower, upper)
        if self._best is self._start:
            converged = self._between(ask, *self._bracket(ask, lower, upper))
        for bound in (lower, upper):
            if 0.0 < abs(self._best.u[0] - bound) <= 3.0 * self._xtol:
                self._costs(ask, [bound], "bound")
        best = self._best
        return Solution(
            self._coordinates.x(best.u),
            best.cost,
            Ending.CONVERGED if converged else Ending.MAX_ITERATIONS,
            iterations=self._progress.iteration,
            at=best.at,
        )

    def _between(self, ask: Ask, low: float, high: float) -> bool:
        """Search an interval; return whether the search converged."""
        from scipy.optimize import minimize_scalar  # slow to import: only a search imports it

        if not self._left > 0:
            return False
        with np.errstate(all="ignore"):  # of differences of infinite costs
            result = minimize_scalar(
                lambda u: self._costs(ask, [float(u)], "trial")[0],
                bounds=(low, high),
                method="bounded",
                options={"xatol": self._xtol, "maxiter": self._left},
            )
        return bool(result.status != 1)

    def _bracket(self, ask: Ask, lower: float, upper: float) -> tuple[float, float]:
        """Step downhill from the start until there is a minimum between two points; return them."""
        step = self._step
        ends = [max(-step, lower), min(step, upper)]
        costs = self._costs(ask, ends, "bracket")
        if min(costs) >= self._start.cost:
            return ends[0], ends[1]
        upwards = int(costs[1] < costs[0])
        previous, current, cost = 0.0, ends[upwards], costs[upwards]
        limit = (lower, upper)[upwards]
        while current != limit and self._left > 0:
            step *= 2.0
            trial = float(np.clip(current + (step if upwards else -step), lower, upper))
            (trial_cost,) = self._costs(ask, [trial], "bracket")
            if trial_cost >= cost:
                return min(previous, trial), max(previous, trial)
            previous, current, cost = current, trial, trial_cost
        return min(previous, current), max(previous, current)

    def _costs(self, ask: Ask, at: list[float], purpose: str) -> list[float]:
        """Ask for costs; infinite where a simulation failed."""
        u = np.array(at)[:, None]
        evaluations = ask(Points(self._coordinates.x(u), purpose, self._progress))
        found = [SimplexVertex(*pair) for pair in zip(u, evaluations, strict=True)]
        before = self._best
        self._best = min([before, *found], key=lambda v: v.cost)
        self._left -= len(found)
        self._progress = Progress(
            self._progress.iteration + 1, self._best.cost, float(abs(self._best.u - before.u)[0])
        )
        return [v.cost for v in found]
