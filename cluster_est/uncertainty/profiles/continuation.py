"""One side of a profile: outwards from the optimum, refitting everything else at each step.

This is a search in the full space like any other, so that all sides of all profiles run at the same
time. Inside it another method searches the space without the profiled unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cluster_est.methods.base import Ending, Method, OtherPoint, Progress, Search, Solution
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.uncertainty.profiles.embedded_search import RequestedIndices, embedded, refit
from cluster_est.uncertainty.profiles.profile_steps import ProfileSteps, ProfileTarget, RefitPoint
from cluster_est.uncertainty.profiles.result import ProfileEnd
from cluster_est.uncertainty.spaces import with_fixed_unknown

FAILURE_FACTOR = 0.25
"""Of the step, after a refit that failed."""
MOST_FAILURES = 5


@dataclass(frozen=True)
class ProfileSolution(Solution):
    """One side of a profile: its points are `others`, and `end` says why it stopped."""

    end: ProfileEnd = ProfileEnd.FAILED


@dataclass(frozen=True)
class ProfileContinuation(Method):
    """Change one unknown step by step until the cost has risen far enough.

    The signed root of the rise is nearly linear in the unknown (D. M. Bates, D. G. Watts, Nonlinear
    Regression Analysis and Its Applications (1988), doi:10.1002/9780470316757, section 6.1), so the
    next step is predicted from the last one, and the end is interpolated.

    Attributes
    ----------
    inner
        Refits the other unknowns. A local method: it starts close to their minimum.
    target
        The unknown, the direction, and the rise of the cost at the end.
    first
        Length of the first step, in search coordinates.
    """

    name: ClassVar[str] = "profile"
    needs_residuals: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    inner: Method
    target: ProfileTarget
    first: float

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        target, i = self.target, self.target.unknown
        steps = ProfileSteps(target, space, [RefitPoint(space.start, target.cost, 0.0)], self.first)
        requested, failures = RequestedIndices(), 0
        # as many steps again, where the profile is so steep that its end must be closed in on
        for number in range(2 * target.max_steps):
            if steps.outside is None and number >= target.max_steps:
                return _solution(steps, ProfileEnd.FLAT)
            value = steps.next_value()
            if value is None:
                break
            x = steps.predicted(value)
            progress = Progress(number, steps.inside[-1].cost, step=steps.length)
            search = refit(self.inner, with_fixed_unknown(space, i, x), generator)
            solution = yield from embedded(search, x, i, requested, progress)
            if _is_valid(solution):
                steps.add(np.insert(solution.x, i, value), solution.cost)
                continue
            failures += 1
            steps.factor *= FAILURE_FACTOR
            if failures == MOST_FAILURES:
                return _solution(steps, ProfileEnd.FAILED)
        return _solution(steps, ProfileEnd.BOUND)


def _solution(steps: ProfileSteps, end: ProfileEnd) -> ProfileSolution:
    """Return all points as others; the end is found once a point is outside the interval."""
    if steps.outside is not None:
        end = ProfileEnd.FOUND
    best = min(steps.points, key=lambda point: point.cost)
    others = tuple(OtherPoint(point.x, point.cost) for point in steps.points)
    ending = Ending.STALLED if end is ProfileEnd.FAILED else Ending.CONVERGED
    return ProfileSolution(best.x, best.cost, ending, str(end), len(others), others=others, end=end)


def _is_valid(solution: Solution) -> bool:
    """Return whether a refit ended at a feasible point."""
    invalid = solution.ending in (Ending.START_FAILED, Ending.INFEASIBLE)
    infeasible = solution.at is not None and not solution.at.feasible
    return bool(np.isfinite(solution.cost)) and not invalid and not infeasible
