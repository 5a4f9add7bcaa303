"""Profile likelihood: intervals that follow a model that bends.

For each chosen unknown the cost is minimised over all others with that one kept, further and
further from the optimum. The interval ends where the cost has risen by s^2 F(1, n - k), which for
a linear model is exactly the interval of Student's t: D. M. Bates, D. G. Watts, Nonlinear
Regression Analysis and Its Applications (1988), doi:10.1002/9780470316757, section 6.1. For a
likelihood s^2 is near 1, and the rise is the likelihood ratio's 3.84 with a correction for few
residuals. A profile that stays flat shows what the data do not determine: A. Raue et al.,
Bioinformatics 25 (2009) 1923-1929, doi:10.1093/bioinformatics/btp358.

Take it where an interval is wide, one-sided or reaches a bound, or where constraints on signals
are active: refits keep all of them. It costs some ten fits for each side of each unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Method, Solution
from cluster_est.problem.space import SearchSpace
from cluster_est.running.runner import Runner, SearchRequest
from cluster_est.uncertainty.covariance.covariance import assess
from cluster_est.uncertainty.covariance.derivatives import linearise
from cluster_est.uncertainty.covariance.layout import is_shared
from cluster_est.uncertainty.covariance.result import Uncertainty
from cluster_est.uncertainty.profiles.result import ProfilePoint, ProfileResult
from cluster_est.uncertainty.profiles.walk import WORDS, Open, ProfileWalk, WalkPoint, crossing
from cluster_est.uncertainty.settings import UncertaintySettings
from cluster_est.uncertainty.spaces import moved
from workers.fmu.description import nearest

BETTER = 1e-3
"""Of the rise: a cost lower than the optimum's by more means that it was none."""


def profiles(
    runner: Runner,
    space: SearchSpace,
    solution: Solution,
    method: Method,
    settings: UncertaintySettings,
) -> tuple[ProfileResult, ...]:
    """Profile the unknowns that the settings name, all at the same time.

    Parameters
    ----------
    runner
        Where the refits run.
    space, solution
        What was searched, and the optimum.
    method
        Refits the other unknowns; a local one, because it starts close to their minimum.
    settings
        Whose profiles, and how fine.

    Raises
    ------
    ProblemError
        See `check_profiles`. Where it is only the solution that does not say how far the cost may
        rise, such as one without residuals, the profiles are open and say so.
    """
    check_profiles(space, settings)
    chosen = select(space, settings.profiles)
    if not chosen or not np.isfinite(solution.cost):
        return ()
    solution = linearise(runner, space, solution)
    known = assess(space, solution)
    rise = _rise(known, settings)
    if not rise > 0.0:
        return tuple(_none(space, solution, i, settings) for i in chosen)
    here = moved(space, solution.x)
    requests = [
        SearchRequest(
            f"profile {space.unknowns[i].label} {'lower' if side < 0 else 'upper'}",
            ProfileWalk(
                method,
                i,
                side,
                solution.cost,
                rise,
                _first(space, solution, known, i, settings.steps),
                settings.steps,
                settings.max_steps,
            ),
            here,
        )
        for i in chosen
        for side in (-1, 1)
    ]
    found = runner.run(requests, settings.at_once)
    return tuple(
        _result(space, solution, requests[2 * j : 2 * j + 2], found[2 * j : 2 * j + 2], settings)
        for j in range(len(chosen))
    )


def select(space: SearchSpace, names: Sequence[str]) -> list[int]:
    """Positions of the unknowns that are named by label, parameter, "shared" or "all".

    Raises
    ------
    ProblemError
        If there is none of a name.
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
    """Refuse profiles that cannot be taken, before anything is simulated.

    Raises
    ------
    ProblemError
        If a name is unknown, or the cost has no weights and no rise is given.
    """
    cost = space.problem.cost
    probe = np.ones(len(space.outputs))
    if not select(space, settings.profiles) or settings.rise > 0.0:
        return
    if len(probe) and cost.weights(probe, space.outputs) is None:
        raise ProblemError(
            "uncertainty.profiles: must be told by the scatter of the residuals how far the cost "
            f"may rise, but the cost {cost.name!r} has no weights; give uncertainty.rise (3.84 for "
            "twice a negative log-likelihood) or use uncertainty.bootstrap"
        )


def _rise(known: Uncertainty, settings: UncertaintySettings) -> float:
    if settings.rise > 0.0:
        return settings.rise
    if known.degrees > 0 and known.variance > 0.0:
        return known.variance * float(fisher.ppf(settings.confidence, 1, known.degrees))
    return np.nan


def _none(
    space: SearchSpace, solution: Solution, i: int, settings: UncertaintySettings
) -> ProfileResult:
    """The profile that was not taken."""
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
        open_lower="unknown",
        open_upper="unknown",
    )


def _first(space: SearchSpace, solution: Solution, known: Uncertainty, i: int, steps: int) -> float:
    """The first step: a part of the interval that the derivatives foretell, if they do."""
    unknown = space.unknowns[i]
    x, error = float(solution.x[i]), known.intervals[i].std_error
    if unknown.log:
        error /= unknown.to_physical(x)
    width = float(space.upper[i] - space.lower[i])
    longest = min(float(space.typical[i]), width)
    return min(2.0 * error / steps, longest) if error > 0.0 else 0.1 * longest


def _result(
    space: SearchSpace,
    solution: Solution,
    requests: Sequence[SearchRequest],
    found: Sequence[Solution],
    settings: UncertaintySettings,
) -> ProfileResult:
    """Join the two sides of a profile."""
    low, high = (_side(request, each) for request, each in zip(requests, found, strict=True))
    walk, unknown = low.walk, space.unknowns[low.walk.unknown]
    points = [*(low.point(space, step) for step in low.path[:0:-1])]
    points += [high.point(space, step) for step in high.path]
    best = min((*low.path, *high.path), key=lambda step: step.cost)
    better = best.cost < solution.cost - BETTER * walk.rise
    return ProfileResult(
        label=unknown.label,
        value=unknown.to_physical(float(solution.x[walk.unknown])),
        cost=solution.cost,
        rise=walk.rise,
        confidence=settings.confidence,
        labels=tuple(each.label for each in space.unknowns),
        points=tuple(points),
        lower=low.end(space),
        upper=high.end(space),
        open_lower=low.why,
        open_upper=high.why,
        better=(space.estimates(best.x), best.cost) if better else None,
    )


@dataclass(frozen=True)
class _ProfileSide:
    """The points of one side, outwards from the optimum, and why it is open."""

    walk: ProfileWalk
    path: list[WalkPoint]
    why: Open

    def point(self, space: SearchSpace, step: WalkPoint) -> ProfilePoint:
        estimates = tuple(space.estimates(step.x).values())
        root = self.walk.side * step.height
        return ProfilePoint(estimates[self.walk.unknown], step.cost, root, estimates)

    def end(self, space: SearchSpace) -> float:
        """The end of the interval, in physical units."""
        if self.why:
            return np.nan if self.why == "failed" else self.walk.side * np.inf
        first = next(j for j, step in enumerate(self.path) if step.height >= 1.0)
        at = crossing(self.path[: first + 1], self.walk.unknown, 1.0)
        return space.unknowns[self.walk.unknown].to_physical(at)


def _side(request: SearchRequest, found: Solution) -> _ProfileSide:
    """What a walk found; one that was ended from outside found nothing but its start."""
    walk, start = request.method, request.space.start
    assert isinstance(walk, ProfileWalk)
    path = [WalkPoint(each.x, each.cost, walk.height(each.cost)) for each in found.others]
    if not path:
        return _ProfileSide(walk, [WalkPoint(start, walk.cost, 0.0)], "failed")
    path.sort(key=lambda step: walk.side * float(step.x[walk.unknown]))
    why = next(word for word in WORDS if word == found.message)
    return _ProfileSide(walk, path, why)
