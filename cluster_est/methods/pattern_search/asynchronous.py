"""A pattern search that does not wait for the slowest simulation.

Every direction of the poll has its own step. As soon as a point is better than the centre of the
poll, the search moves to it. Points around the old centre that have not begun are dropped. If a
point is not better, its direction is tried again with a smaller step, independently of the other
directions. P. D. Hough, T. G. Kolda, V. J. Torczon, Asynchronous parallel pattern search for
nonlinear optimization, SIAM J. Sci. Comput. 23 (2001) 134-156, doi:10.1137/S1064827599365823; with
one coordinator, T. G. Kolda, SIAM J. Optim. 16 (2005) 563-586, doi:10.1137/040603589.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.method import Ending, Evaluation, Points, Progress, Search, Solution
from cluster_est.methods.pattern_search.poll_directions import PatternMethod
from cluster_est.methods.pattern_search.state import PatternState, key
from cluster_est.methods.pattern_search.synchronous import (
    contracted,
    mesh_after_step,
    progress_of,
    solution_of,
)
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

NO_DIRECTION = -1


@dataclass
class RequestedPoint:
    """A point that was requested and is not evaluated yet.

    Attributes
    ----------
    u, mesh
        Coordinates, and the length of the step.
    direction
        Index of the direction of the current poll that waits for this point, or `NO_DIRECTION`.
    overtaken
        Number of points that were requested later and evaluated earlier.
    """

    u: FloatArray
    mesh: float
    direction: int = NO_DIRECTION
    overtaken: int = 0


class PollState:
    """The outstanding points and the progress of the poll around the current centre.

    Parameters
    ----------
    state, options
        State and options of the search.
    limit
        Largest number of outstanding points.

    Attributes
    ----------
    ending
        Ending of the search; None before the end.
    progress
        A line of the iteration table.
    """

    def __init__(self, state: PatternState, options: PatternMethod, limit: int) -> None:
        self._state = state
        self._options = options
        self._limit = limit
        self._outstanding: dict[int, RequestedPoint] = {}
        self._dropped: list[int] = []
        self._next_index = 1  # the start was 0
        self._newest = 0
        self._answered = 0
        self.ending = Ending.CONVERGED if state.feasible_point_suffices else None
        self.progress = progress_of(state, 0, options.initial_mesh, np.nan)
        self._begin(options.initial_mesh)

    def next_requests(self) -> list[RequestedPoint]:
        """Return the points to request now; none if the search must wait or has ended."""
        found: list[RequestedPoint] = []
        while self.ending is None:
            while self._free_slots > 0 and (asked := self._next_new()) is not None:
                self._outstanding[self._next_index] = asked
                self._next_index += 1
                found.append(asked)
            if found or any(
                asked.direction != NO_DIRECTION for asked in self._outstanding.values()
            ):
                break
            if not self._refine():  # all directions were tried at evaluated points
                break
        return found

    def take_dropped(self) -> tuple[int, ...]:
        """Return the indices of points to drop; all outstanding points at the end."""
        if self.ending is not None:
            self._dropped += self._outstanding
            self._outstanding.clear()
        found, self._dropped = tuple(self._dropped), []
        return found

    def receive(self, evaluations: list[Evaluation]) -> None:
        """Process evaluations: move, shorten steps, or begin another poll."""
        state = self._state
        numbers = {self._add(evaluation): evaluation.index for evaluation in evaluations}
        meshes = {number: self._outstanding.pop(index).mesh for number, index in numbers.items()}
        if state.feasible_point_suffices:
            self.ending = Ending.CONVERGED
            return
        if not state.calibrated:
            if len(state.evaluated) > len(state.u):
                self._calibrate()
            return
        better = state.better(list(numbers))
        if better is not None:
            length = state.move(better)
            mesh = mesh_after_step(self._options, meshes[better], length)
            self._begin(max(mesh, state.tolerance))
            self._update_progress(length)
            return
        for asked in self._outstanding.values():
            if asked.direction != NO_DIRECTION and asked.overtaken >= self._late:
                self._shorten(asked.direction)  # the point is slow; its evaluation is still used
                asked.direction = NO_DIRECTION
        self._refine()

    @property
    def _late(self) -> int:
        """Number of overtaking points after which a point is slow and no direction waits for it."""
        return len(self._state.u)

    @property
    def _free_slots(self) -> int:
        """Number of points that may be requested; slow points do not occupy a slot."""
        return self._limit - sum(
            asked.overtaken < self._late for asked in self._outstanding.values()
        )

    def _calibrate(self) -> bool:
        """Choose the penalty and begin a new poll; return whether there is a penalty."""
        self._state.calibrate()
        self._begin(self._mesh)
        return self._state.calibrated

    def _add(self, evaluation: Evaluation) -> int:
        """Add an evaluation; return the number of its point."""
        asked = self._outstanding[evaluation.index]
        if asked.direction != NO_DIRECTION:
            self._shorten(asked.direction)
        for index, other in self._outstanding.items():
            other.overtaken += index < evaluation.index
        self._newest = max(self._newest, evaluation.index)
        self._answered += 1
        return self._state.add(asked.u, evaluation)

    def _begin(self, mesh: float) -> None:
        """Begin a poll; drop points of the last poll that may not have begun.

        Simulations begin in the order of requests. A point requested before an evaluated point has
        begun, so it is kept.
        """
        self._drop([index for index in self._outstanding if index > self._newest])
        for asked in self._outstanding.values():
            asked.direction = NO_DIRECTION
        self._mesh = mesh
        self._plan = self._state.plan(mesh)
        self._steps = np.full(len(self._plan.directions), mesh)
        self._directions = deque(range(len(self._steps)))
        self._promising = deque(self._plan.promising)
        self._sample = deque(self._plan.sample)

    def _refine(self) -> bool:
        """Refine the mesh if every direction was tried with it; return whether it did.

        The search ends only after all outstanding points are evaluated, as one could be better.
        """
        largest = float(self._steps.max(initial=0.0))
        if largest >= self._mesh:
            return False
        mesh = min(largest, contracted(self._options, self._mesh, self._plan))
        finished = mesh < self._state.tolerance
        if finished and self._outstanding and self._state.tolerance <= self._options.mesh_tolerance:
            return False
        if not self._state.calibrated and self._calibrate():
            return True
        self._state.poll_failed()
        if finished:
            self.ending, mesh = self._state.at_tolerance()
        if self.ending is None:
            self._begin(mesh)
        self._update_progress(0.0)
        return True

    def _next_new(self) -> RequestedPoint | None:
        """Return the next point to request that is not outstanding, if any."""
        out = {key(asked.u): asked for asked in self._outstanding.values()}
        while True:
            asked = self._candidate()
            if asked is None:
                return None
            twin = out.get(key(asked.u))
            if twin is None:
                return asked
            if twin.direction == NO_DIRECTION:
                twin.direction = asked.direction
            elif asked.direction != NO_DIRECTION:
                self._shorten(asked.direction)

    def _candidate(self) -> RequestedPoint | None:
        """Return the next point of the poll, which may be outstanding already."""
        while True:
            if self._promising:
                return RequestedPoint(self._promising.popleft(), self._mesh)
            if self._directions:
                found = self._in_direction(self._directions.popleft())
                if found is not None:
                    return found
            elif self._sample:
                return RequestedPoint(self._sample.popleft(), self._mesh)
            else:
                return None

    def _in_direction(self, direction: int) -> RequestedPoint | None:
        """Return the point in a direction; None if it is evaluated or the step is too short."""
        step = float(self._steps[direction])
        if step < self._state.tolerance:
            return None
        candidate = self._state.u + step * self._plan.directions[direction]
        found = self._state.new([candidate], self._plan.constraint_jacobian)
        if not len(found):
            self._shorten(direction)
            return None
        return RequestedPoint(found[0], step, direction)

    def _shorten(self, direction: int) -> None:
        self._steps[direction] *= self._options.contraction
        self._directions.append(direction)

    def _drop(self, indices: list[int]) -> None:
        for index in indices:
            del self._outstanding[index]
        self._dropped += indices

    def _update_progress(self, length: float) -> None:
        iteration = self._answered // (2 * len(self._state.u))
        self.progress = progress_of(self._state, iteration, self._mesh, length)


@dataclass(frozen=True)
class AsynchronousPatternSearch(PatternMethod):
    """Pattern search that uses each simulation as soon as it ends.

    Use it with many workers if simulation times differ widely, as with adaptive solvers or shared
    machines. The search does not wait for the slowest simulation, except for the outstanding points
    before it ends. If all simulations take equally long, `pattern_search` needs fewer evaluations.
    The result depends on the order in which simulations end, so a run cannot be repeated exactly.

    Attributes
    ----------
    outstanding
        Number of outstanding points at any time, without slow points; 0 selects twice the number of
        unknowns. It should exceed the number of workers, so that no worker is idle.
    basis, axes, search_step, search_points, initial_mesh, mesh_tolerance, expansion, contraction
        As in `pattern_search`, for each direction separately.
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
