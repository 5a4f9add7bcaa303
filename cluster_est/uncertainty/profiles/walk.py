"""One side of a profile: outwards from the optimum, refitting everything else at each step.

The walk is a search in the full space like any other, so that all sides of all profiles run at the
same time. Inside it another method searches the space without the profiled unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np

from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Method,
    OtherPoint,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.space import SearchSpace
from cluster_est.uncertainty.spaces import without
from workers.messages import FloatArray

Open = Literal["", "bound", "flat", "failed", "unknown"]
"""Why a profile has no end on one side; "" where it has one."""
WORDS: tuple[Open, ...] = ("", "bound", "flat", "failed", "unknown")

CLOSE = 1e-3
"""How close to the end, in units of `height`, a point is close enough."""
NARROW = 1e-6
"""Of the interval: where a profile is as good as vertical, its end is known as well as this."""
GROWTH = 3.0
CAUTION = 0.25
LONGEST_LOG = 2.3
"""A logarithm moves by no more than a factor of ten at a time."""
MOST_FAILURES = 5


@dataclass(frozen=True)
class WalkPoint:
    """A point of a profile: where, its cost, and the height there.

    The height is the root of the cost's rise over the rise at the end of the interval: 0 at the
    optimum, 1 at the end, and in between a straight line where the model is linear.
    """

    x: FloatArray
    cost: float
    height: float


@dataclass(frozen=True)
class ProfileWalk(Method):
    """Walk one unknown outwards until the cost has risen far enough.

    The signed root of the rise is nearly linear in the unknown (D. M. Bates, D. G. Watts, Nonlinear
    Regression Analysis and Its Applications (1988), doi:10.1002/9780470316757, section 6.1), so the
    next step is foretold from the last one, and the end is interpolated.

    Attributes
    ----------
    inner
        Refits the other unknowns. A local method: it starts close to their minimum.
    unknown
        Position of the profiled unknown.
    side
        1 for upwards, -1 for downwards.
    cost, rise
        At the optimum, and by how much it must rise.
    first
        Length of the first step, in search coordinates.
    steps, max_steps
        See `UncertaintySettings`.
    """

    name: ClassVar[str] = "profile"
    needs_residuals: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    inner: Method
    unknown: int
    side: int
    cost: float
    rise: float
    first: float
    steps: int = 4
    max_steps: int = 20

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        trail = _ProfileTrail(self, space, [WalkPoint(space.start, self.cost, 0.0)], self.first)
        asked, failures, ending = _AskedPoints(), 0, ""
        # as many steps again, where the profile is so steep that its end must be closed in on
        for number in range(2 * self.max_steps):
            if trail.beyond is None and number >= self.max_steps:
                ending = "flat"
                break
            target = trail.target()
            if target is None:
                break
            guess = trail.guess(target)
            progress = Progress(number, trail.inside[-1].cost, step=trail.length)
            search = _refit(self.inner, without(space, self.unknown, guess), generator)
            solution = yield from _embedded(search, guess, self.unknown, asked, progress)
            if _usable(solution):
                trail.add(np.insert(solution.x, self.unknown, target), solution.cost)
                continue
            failures += 1
            trail.caution *= CAUTION
            if failures == MOST_FAILURES:
                ending = "failed"
                break
        return self._solution(trail, ending)

    def _solution(self, trail: _ProfileTrail, ending: str) -> Solution:
        """All points as others; the message is a word of `Open`."""
        if trail.beyond is not None:
            ending = ""
        elif not ending:
            ending = "bound"
        best = min(trail.all, key=lambda step: step.cost)
        others = tuple(OtherPoint(step.x, step.cost) for step in trail.all)
        code = Ending.STALLED if ending == "failed" else Ending.CONVERGED
        return Solution(best.x, best.cost, code, ending, len(others), others=others)

    def height(self, cost: float) -> float:
        return float(np.sqrt(max(cost - self.cost, 0.0) / self.rise))


@dataclass
class _ProfileTrail:
    """The points so far: those inside the interval, in order, and the nearest one outside.

    `length` is that of the next step outwards, `caution` the part of it that is dared after a
    failure, `halve` whether the last step towards the end left more than half of the gap.
    """

    walk: ProfileWalk
    space: SearchSpace
    inside: list[WalkPoint]
    length: float
    beyond: WalkPoint | None = None
    caution: float = 1.0
    halve: bool = False
    all: list[WalkPoint] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.all = list(self.inside)

    @property
    def gap(self) -> float:
        """Between the last point inside and the first outside."""
        i = self.walk.unknown
        there = np.inf if self.beyond is None else float(self.beyond.x[i])
        return abs(there - float(self.inside[-1].x[i]))

    def target(self) -> float | None:
        """The profiled unknown's next value; None if the end is known or there is no room."""
        here = float(self.inside[-1].x[self.walk.unknown])
        wanted = self._outwards(here) if self.beyond is None else self._closer(self.beyond, here)
        if wanted is None or wanted == here:
            return None
        return here + self.caution * (wanted - here) if self.caution < 1.0 else wanted

    def _outwards(self, here: float) -> float:
        i = self.walk.unknown
        ahead = here + self.walk.side * self.length
        return float(np.clip(ahead, self.space.lower[i], self.space.upper[i]))

    def _closer(self, beyond: WalkPoint, here: float) -> float | None:
        """Between the last point inside and the one outside."""
        last, part = self.inside[-1], 1.0 / self.walk.steps
        there = float(beyond.x[self.walk.unknown])
        if beyond.height <= 1.0 + CLOSE or last.height >= 1.0 - CLOSE:
            return None
        if self.gap <= NARROW * abs(there - float(self.inside[0].x[self.walk.unknown])):
            return None
        if self.halve:
            return 0.5 * (here + there)
        near = 1.0 - last.height <= 1.5 * part
        height = 1.0 if near else last.height + part
        wanted = crossing([*self.inside, beyond], self.walk.unknown, height)
        margin = 0.01 * (there - here)
        low, high = sorted([here + margin, there - margin])
        return float(np.clip(wanted, low, high))

    def guess(self, target: float) -> FloatArray:
        """Where the others may be: on the line through the last two points."""
        i, last = self.walk.unknown, self.inside[-1]
        x = last.x.copy()
        if len(self.inside) > 1:
            before = self.inside[-2]
            width = last.x[i] - before.x[i]
            x += (target - last.x[i]) / width * (last.x - before.x)
        x = np.clip(x, self.space.lower, self.space.upper)
        x[i] = target
        return x

    def add(self, x: FloatArray, cost: float) -> None:
        """Keep a point."""
        step, last, gap = WalkPoint(x, cost, self.walk.height(cost)), self.inside[-1], self.gap
        self.all.append(step)
        self.caution = 1.0
        if step.height >= 1.0:
            self.beyond = step
        else:
            self.inside.append(step)
            self.length = self._next_length(last, step)
        self.halve = self.gap > 0.5 * gap if np.isfinite(gap) and not self.halve else False

    def _next_length(self, last: WalkPoint, step: WalkPoint) -> float:
        """As far as the profile seems to need for the next part of its height."""
        i = self.walk.unknown
        width, climbed = abs(float(step.x[i] - last.x[i])), step.height - last.height
        wanted = min(1.0 / self.walk.steps, max(1.02 - step.height, CLOSE))
        factor = wanted / climbed if climbed > 0.0 else GROWTH
        longest = LONGEST_LOG if self.space.unknowns[i].log else np.inf
        return min(width * min(max(factor, 1.0 / GROWTH), GROWTH), longest)


def crossing(path: list[WalkPoint], i: int, height: float) -> float:
    """Where unknown i is at a height, between the last two points of a path.

    By a parabola through the last three where it is monotonic there, else by a straight line.
    """
    a, b = path[-2], path[-1]
    here, there = float(a.x[i]), float(b.x[i])
    share = (height - a.height) / (b.height - a.height)
    straight = here + share * (there - here)
    if len(path) < 3 or not path[-3].height < a.height < b.height:
        return straight
    before = path[-3]
    slope = (there - here) / (b.height - a.height)
    earlier = (here - float(before.x[i])) / (a.height - before.height)
    bend = (slope - earlier) / (b.height - before.height)
    bent = straight + bend * (height - a.height) * (height - b.height)
    low, high = sorted([here, there])
    return bent if low <= bent <= high else straight


def _refit(inner: Method, space: SearchSpace, generator: np.random.Generator) -> Search:
    """The inner search; a mere evaluation where nothing is left to search."""
    if space.size:
        return (yield from inner.search(space, generator))
    (at,) = yield Points(space.start[None, :], "start")
    ending = Ending.CONVERGED if at.ok else Ending.START_FAILED
    return Solution(space.start, at.cost, ending, at=at)


def _usable(solution: Solution) -> bool:
    bad = solution.ending in (Ending.START_FAILED, Ending.INFEASIBLE)
    infeasible = solution.at is not None and not solution.at.feasible
    return bool(np.isfinite(solution.cost)) and not bad and not infeasible


@dataclass
class _AskedPoints:
    """How many points a walk has asked for, and which of them nobody has answered."""

    count: int = 0
    waiting: set[int] = field(default_factory=set)


def _embedded(
    search: Search, x: FloatArray, i: int, asked: _AskedPoints, progress: Progress
) -> Search:
    """Drive a search of the space without unknown i in the full space.

    Each side counts points in its own way, and what an earlier search left unanswered is dropped.
    """
    before, stale = asked.count, tuple(sorted(asked.waiting))
    asked.waiting.clear()
    answers: list[Evaluation] | None = None
    while True:
        try:
            points = next(search) if answers is None else search.send(answers)
        except StopIteration as end:
            solution: Solution = end.value
            return solution
        dropped = tuple(index + before for index in points.drop)
        asked.waiting.update(range(asked.count, asked.count + len(points.x)))
        asked.waiting.difference_update(dropped)
        asked.count += len(points.x)
        full = np.insert(points.x, i, x[i], axis=1)
        found = yield replace(points, x=full, progress=progress, drop=(*stale, *dropped))
        asked.waiting.difference_update(each.index for each in found)
        stale = ()
        answers = [replace(each, index=each.index - before) for each in found]
