"""A search of the space without one unknown, driven as a part of a search of the full space."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray


@dataclass
class RequestedIndices:
    """The number of points that a search has requested, and the indices not answered yet."""

    count: int = 0
    outstanding: set[int] = field(default_factory=set)


def refit(method: Method, space: SearchSpace, generator: np.random.Generator) -> Search:
    """Search a space; only evaluate its start where no unknown is left."""
    if space.size:
        return (yield from method.search(space, generator))
    (at,) = yield Points(space.start[None, :], "start")
    ending = Ending.CONVERGED if at.ok else Ending.START_FAILED
    return Solution(space.start, at.cost, ending, at=at)


def embedded(
    search: Search, x: FloatArray, i: int, requested: RequestedIndices, progress: Progress
) -> Search:
    """Run a search of the space without unknown i in the full space, where that is x[i].

    Both number points in their own way. Points that an earlier search left unanswered are dropped.
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
