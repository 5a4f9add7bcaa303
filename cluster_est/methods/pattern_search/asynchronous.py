"""A pattern search that never waits for the slowest simulation.

Every direction of the poll has a step of its own. As soon as a point is better than the centre of
the poll, the search moves there, and points around the old centre that have not begun are dropped;
a direction in which a point was no better is tried again with a smaller step, whatever the others
do. P. D. Hough, T. G. Kolda, V. J. Torczon, Asynchronous parallel pattern search for
nonlinear optimization, SIAM J. Sci. Comput. 23 (2001) 134-156, doi:10.1137/S1064827599365823; with
one coordinator, T. G. Kolda, SIAM J. Optim. 16 (2005) 563-586, doi:10.1137/040603589.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.base import Ending, Points, Progress, Search, Solution
from cluster_est.methods.pattern_search.asynchronous_state import PollState
from cluster_est.methods.pattern_search.method import solution_of
from cluster_est.methods.pattern_search.options import PatternMethod
from cluster_est.methods.pattern_search.state import PatternState
from cluster_est.problem.search_space.space import SearchSpace


@dataclass(frozen=True)
class AsynchronousPatternSearch(PatternMethod):
    """Pattern search that uses each simulation as soon as it ends.

    For simulations that take very different times, as with adaptive solvers or machines that others
    use too, and many workers: the slowest holds up nothing. Where all take equally long,
    `pattern_search` does the same with fewer evaluations. What it finds depends on the order in
    which simulations end, so a run cannot be repeated exactly. Only before it ends it waits for all
    that was asked around its last point.

    Attributes
    ----------
    outstanding
        Number of points that are requested and not answered at any time, slow ones not counted; 0
        for twice the number of unknowns. Should be more than there are workers: those that wait
        fill gaps.
    basis, axes, search_step, search_points, initial_mesh, mesh_tolerance, expansion, contraction
        As in `pattern_search`, for each direction on its own.
    max_iterations
        Limit on the evaluations, in polls of twice the number of unknowns.
    """

    name: ClassVar[str] = "asynchronous_pattern_search"
    asynchronous: ClassVar[bool] = True

    outstanding: int = field(default=0, metadata={"least": 0})

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        (at,) = yield Points(space.start[None, :], "start", Progress(0, np.nan))
        if not at.ok:
            return Solution(space.start, np.nan, Ending.START_FAILED, at.reason)
        state = PatternState(space, self, generator, at)
        poll = PollState(state, self, self.outstanding or 2 * space.size)
        while True:
            requests = poll.next_requests()
            drop = poll.take_dropped()
            if poll.ending is not None:
                break
            x = np.array([state.coordinates.x(point.u) for point in requests]).reshape(
                -1, space.size
            )
            answers = yield Points(x, "poll", poll.progress, asynchronous=True, drop=drop)
            poll.receive(answers)
            if poll.progress.iteration >= self.max_iterations and poll.ending is None:
                poll.ending = Ending.MAX_ITERATIONS
        if drop:
            nothing = np.zeros((0, space.size))
            yield Points(nothing, "poll", poll.progress, asynchronous=True, drop=drop)
        return solution_of(state, poll.ending, poll.progress.iteration)
