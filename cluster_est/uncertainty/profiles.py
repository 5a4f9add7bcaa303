"""Profile likelihoods: intervals from refits, for models that are nonlinear within the interval.

Each chosen unknown is fixed at values further and further from the optimum, and the cost is
minimised over the other unknowns. The interval ends at a cost increase of s^2 F(1, n - k). For a
linear model, this is exactly the interval of Student's t (D. M. Bates, D. G. Watts, Nonlinear
Regression Analysis and Its Applications (1988), doi:10.1002/9780470316757, section 6.1). For a
likelihood, s^2 is near 1, and the increase is the 3.84 of the likelihood ratio with a correction
for few residuals. If the noise is not white, the increase is larger by the same factor as the
square of the standard error (A. Rotnitzky, N. P. Jewell, Biometrika 77 (1990) 485-497,
doi:10.1093/biomet/77.3.485). A flat profile shows that the data do not determine the unknown (A.
Raue et al., Bioinformatics 25 (2009) 1923-1929, doi:10.1093/bioinformatics/btp358).

Use it if an interval is wide, one-sided or reaches a bound, or if constraints on signals are
active, because refits satisfy all constraints. It takes about ten fits for each side of each
unknown. Each side is a search in the full space, so all sides of all profiles run at the same time.
Within this search, another method searches the space without the profiled unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.special import fdtri

from cluster_est.errors import ProblemError
from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    OtherPoint,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.compatibility import refuse_ordinal_outputs
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty.covariance.covariance import assess
from cluster_est.uncertainty.covariance.derivatives import linearise
from cluster_est.uncertainty.covariance.local_uncertainty import Uncertainty
from cluster_est.uncertainty.covariance.normal_equations import is_shared
from cluster_est.uncertainty.profile_points import (
    ProfileEnd,
    ProfilePoint,
    ProfileResult,
    ProfileSteps,
    ProfileTarget,
    RefitPoint,
    crossing,
)
from cluster_est.uncertainty.spaces import with_fixed_unknown, with_start
from cluster_est.uncertainty.uncertainty_settings import UncertaintySettings
from workers.fmu.description import nearest
from workers.messages import FloatArray


@dataclass
class RequestedIndices:
    """The number of points that a search has requested, and the indices not answered yet."""

    count: int = 0
    outstanding: set[int] = field(default_factory=set)


def refit(method: Method, space: SearchSpace, generator: np.random.Generator) -> Search:
    """Search a space; if it has no unknowns, only evaluate its start."""
    if space.size:
        return (yield from method.search(space, generator))
    (at,) = yield Points(space.start[None, :], "start")
    ending = Ending.CONVERGED if at.ok else Ending.START_FAILED
    return Solution(space.start, at.cost, ending, at=at)


def embedded(
    search: Search, x: FloatArray, i: int, requested: RequestedIndices, progress: Progress
) -> Search:
    """Run a search of the space without unknown i in the full space, with this unknown at x[i].

    The indices of the points are converted. Unanswered points of an earlier search are dropped.
    """
    offset, stale = requested.count, tuple(sorted(requested.outstanding))
    requested.outstanding.clear()
    answers: list[Evaluation] | None = None
    while True:
        try:
            points = next(search) if answers is None else search.send(answers)
        except StopIteration as end:
            solution: Solution = end.value
            return solution
        dropped = tuple(index + offset for index in points.drop)
        requested.outstanding.update(range(requested.count, requested.count + len(points.x)))
        requested.outstanding.difference_update(dropped)
        requested.count += len(points.x)
        full = np.insert(points.x, i, x[i], axis=1)
        found = yield replace(points, x=full, progress=progress, drop=(*stale, *dropped))
        requested.outstanding.difference_update(each.index for each in found)
        stale = ()
        answers = [replace(each, index=each.index - offset) for each in found]


FAILURE_FACTOR = 0.25
"""Factor on the step after a failed refit."""
MOST_FAILED_REFITS = 5


@dataclass(frozen=True)
class ProfileSolution(Solution):
    """One side of a profile: its points are `others`, and `end` is the reason of its end."""

    end: ProfileEnd = ProfileEnd.FAILED


@dataclass(frozen=True)
class ProfileContinuation(Method):
    """Changes one unknown in steps until the cost has risen enough.

    The signed root of the rise is nearly linear in the unknown (D. M. Bates, D. G. Watts, Nonlinear
    Regression Analysis and Its Applications (1988), doi:10.1002/9780470316757, section 6.1). So the
    next step is predicted from the last one, and the end is interpolated.

    Attributes
    ----------
    inner
        Method that refits the other unknowns; a local method, because it starts near their minimum.
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
        # further steps, as many again, may be necessary to locate the end of a steep profile
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
            if failures == MOST_FAILED_REFITS:
                return _solution(steps, ProfileEnd.FAILED)
        return _solution(steps, ProfileEnd.BOUND)


def _solution(steps: ProfileSteps, end: ProfileEnd) -> ProfileSolution:
    """Return all points as `others`; the end is known if a point is outside the interval."""
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


BETTER_OPTIMUM = 1e-3
"""Decrease of the cost over the rise, above which a point is a better optimum."""


def profiles(
    runner: Runner,
    space: SearchSpace,
    solution: Solution,
    method: Method,
    settings: UncertaintySettings,
) -> tuple[ProfileResult, ...]:
    """Compute the profiles of the unknowns in the settings, all at the same time.

    If the residuals do not determine the rise of the cost, the profiles have no ends.

    Parameters
    ----------
    runner
        Runs the refits.
    space, solution
        The search space, and the optimum.
    method
        Method that refits the other unknowns; a local method, because it starts near their minimum.
    settings
        The unknowns, and the number of steps.

    Raises
    ------
    ProblemError
        See `check_profiles`.
    """
    check_profiles(space, settings)
    chosen = select(space, settings.profiles)
    if not chosen or not np.isfinite(solution.cost):
        return ()
    solution = linearise(runner, space, solution)
    linear = assess(space, solution)
    rises = {i: _rise(linear, i, settings) for i in chosen}
    if not all(rise > 0.0 for rise in rises.values()):
        return tuple(_undetermined(space, solution, i, settings) for i in chosen)
    start_space, steps = with_start(space, solution.x), (settings.steps, settings.max_steps)
    continuations = []
    for i in chosen:
        first = _first_step(space, solution, linear, i, settings.steps)
        targets = [ProfileTarget(i, side, solution.cost, rises[i], *steps) for side in (-1, 1)]
        continuations += [ProfileContinuation(method, target, first) for target in targets]
    requests = [
        SearchRequest(_search_name(space, each), each, start_space) for each in continuations
    ]
    found = runner.run(requests, settings.at_once)
    sides = [_side(*pair, start_space.start) for pair in zip(continuations, found, strict=True)]
    pairs = zip(sides[::2], sides[1::2], strict=True)
    return tuple(_result(space, solution, *pair, settings) for pair in pairs)


def _search_name(space: SearchSpace, continuation: ProfileContinuation) -> str:
    """Return the name of one side's search in the log."""
    side = "lower" if continuation.target.direction < 0 else "upper"
    return f"profile {space.unknowns[continuation.target.unknown].label} {side}"


def select(space: SearchSpace, names: Sequence[str]) -> list[int]:
    """Return the positions of unknowns, given by label, parameter, "shared" or "all".

    Raises
    ------
    ProblemError
        If no unknown has one of the names.
    """
    shared = is_shared(space)
    chosen: set[int] = set()
    for name in names:
        found = {
            i
            for i, unknown in enumerate(space.unknowns)
            if name in (unknown.label, unknown.parameter.name, "all")
            or (name == "shared" and shared[i])
        }
        if not found and name not in ("all", "shared"):
            labels = [unknown.label for unknown in space.unknowns]
            raise ProblemError(
                f"uncertainty.profiles: must name estimated parameters, such as {labels[0]!r}, "
                f'or "shared" or "all", but has {name!r}{nearest(name, labels)}'
            )
        chosen |= found
    return sorted(chosen)


def check_profiles(space: SearchSpace, settings: UncertaintySettings) -> None:
    """Refuse profiles that cannot be computed, before any simulation.

    Raises
    ------
    ProblemError
        If a name is unknown, or the cost has no weights and no rise is given.
    """
    cost = space.problem.cost
    probe = np.ones(len(space.outputs))
    if not select(space, settings.profiles) or settings.rise > 0.0:
        return
    refuse_ordinal_outputs(
        space,
        "uncertainty.profiles",
        "set uncertainty.rise (how far the cost may rise), or use uncertainty.bootstrap",
    )
    if len(probe) and cost.weights(probe, space.outputs) is None:
        raise ProblemError(
            "uncertainty.profiles: needs the scatter of the residuals to know how far the cost may "
            f"rise, but the cost {cost.name!r} has no weights; set uncertainty.rise (3.84 for "
            "twice a negative log-likelihood) or use uncertainty.bootstrap"
        )


def _rise(linear: Uncertainty, i: int, settings: UncertaintySettings) -> float:
    """Return the increase of the cost at the ends of an unknown's interval.

    It is proportional to the square of the standard error, which includes the effects of noise that
    is not white and of priors.
    """
    if settings.rise > 0.0:
        return settings.rise
    if not (linear.degrees > 0 and linear.variance > 0.0):
        return np.nan
    interval = linear.intervals[i]
    uniform = interval.error_uniform
    of_curvature = uniform if np.isfinite(uniform) else interval.error_white
    larger = (interval.std_error / of_curvature) ** 2
    if not np.isfinite(larger):
        return linear.variance * float(fdtri(1, linear.degrees, settings.confidence))
    return linear.variance * larger * float(fdtri(1, linear.basis_degrees, settings.confidence))


def _undetermined(
    space: SearchSpace, solution: Solution, i: int, settings: UncertaintySettings
) -> ProfileResult:
    """Return a profile with only the optimum, if the rise at its ends is not known."""
    estimates = tuple(space.estimates(solution.x).values())
    return ProfileResult(
        label=space.unknowns[i].label,
        value=estimates[i],
        cost=solution.cost,
        rise=np.nan,
        confidence=settings.confidence,
        labels=tuple(each.label for each in space.unknowns),
        points=(ProfilePoint(estimates[i], solution.cost, 0.0, estimates),),
        lower=np.nan,
        upper=np.nan,
        open_lower=ProfileEnd.UNKNOWN,
        open_upper=ProfileEnd.UNKNOWN,
    )


def _first_step(
    space: SearchSpace, solution: Solution, linear: Uncertainty, i: int, steps: int
) -> float:
    """Return the first step: a part of the interval from derivatives, if there is one."""
    unknown = space.unknowns[i]
    x, error = float(solution.x[i]), linear.intervals[i].std_error
    if unknown.log:
        error /= unknown.to_physical(x)
    width = float(space.upper[i] - space.lower[i])
    longest = min(float(space.typical[i]), width)
    return min(2.0 * error / steps, longest) if error > 0.0 else 0.1 * longest


@dataclass(frozen=True)
class _ProfileSide:
    """The points of one side of a profile, from the optimum outwards, and its end."""

    target: ProfileTarget
    path: list[RefitPoint]
    end: ProfileEnd

    def point(self, space: SearchSpace, refit: RefitPoint) -> ProfilePoint:
        """Return a point in physical units."""
        estimates = tuple(space.estimates(refit.x).values())
        root = self.target.direction * refit.root
        return ProfilePoint(estimates[self.target.unknown], refit.cost, root, estimates)

    def limit(self, space: SearchSpace) -> float:
        """Return the end of the interval, in physical units."""
        if self.end is ProfileEnd.FAILED:
            return np.nan
        if self.end is not ProfileEnd.FOUND:
            return self.target.direction * np.inf
        first = next(j for j, refit in enumerate(self.path) if refit.root >= 1.0)
        at = crossing(self.path[: first + 1], self.target.unknown, 1.0)
        return space.unknowns[self.target.unknown].to_physical(at)


def _side(continuation: ProfileContinuation, found: Solution, start: FloatArray) -> _ProfileSide:
    """Return the points of a search; a search that was stopped has only its start."""
    target = continuation.target
    if not isinstance(found, ProfileSolution):
        return _ProfileSide(target, [RefitPoint(start, target.cost, 0.0)], ProfileEnd.FAILED)
    path = [RefitPoint(each.x, each.cost, target.root(each.cost)) for each in found.others]
    path.sort(key=lambda refit: target.direction * float(refit.x[target.unknown]))
    return _ProfileSide(target, path, found.end)


def _result(
    space: SearchSpace,
    solution: Solution,
    low: _ProfileSide,
    high: _ProfileSide,
    settings: UncertaintySettings,
) -> ProfileResult:
    """Join the two sides of a profile."""
    target = low.target
    points = [*(low.point(space, refit) for refit in low.path[:0:-1])]
    points += [high.point(space, refit) for refit in high.path]
    best = min((*low.path, *high.path), key=lambda refit: refit.cost)
    better = best.cost < solution.cost - BETTER_OPTIMUM * target.rise
    return replace(
        _undetermined(space, solution, target.unknown, settings),
        rise=target.rise,
        points=tuple(points),
        lower=low.limit(space),
        upper=high.limit(space),
        open_lower=low.end,
        open_upper=high.end,
        better=(space.estimates(best.x), best.cost) if better else None,
    )
