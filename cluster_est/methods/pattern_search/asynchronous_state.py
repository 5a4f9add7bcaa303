"""What an asynchronous pattern search waits for, and what it asks for next."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from cluster_est.methods.base import Ending, Evaluation
from cluster_est.methods.pattern_search.evaluated_points import key
from cluster_est.methods.pattern_search.method import progress_of, shrunk, stepped
from cluster_est.methods.pattern_search.options import PatternMethod
from cluster_est.methods.pattern_search.state import PatternState
from workers.messages import FloatArray

NONE = -1


@dataclass
class RequestedPoint:
    """A point that was asked for.

    Attributes
    ----------
    u, mesh
        Where, and how large the step was.
    direction
        Of the present poll, if that direction waits for it, or NONE.
    overtaken
        How many points that were asked for later have come back.
    """

    u: FloatArray
    mesh: float
    direction: int = NONE
    overtaken: int = 0


class PollState:
    """What is outstanding, and how far the poll around the present point is.

    Parameters
    ----------
    state, options
        Of the search.
    most
        How many points may be outstanding.

    Attributes
    ----------
    ending
        How the search ended, once it has.
    progress
        Where it stands.
    """

    def __init__(self, state: PatternState, options: PatternMethod, most: int) -> None:
        self._state = state
        self._options = options
        self._most = most
        self._out: dict[int, RequestedPoint] = {}
        self._unwanted: list[int] = []
        self._next_index = 1  # the start was 0
        self._newest = 0
        self._answered = 0
        self.ending = Ending.CONVERGED if state.satisfied else None
        self.progress = progress_of(state, 0, options.initial_mesh, np.nan)
        self._begin(options.initial_mesh)

    def next(self) -> list[RequestedPoint]:
        """What to ask for now; nothing if it is time to wait, or at the end."""
        found: list[RequestedPoint] = []
        while self.ending is None:
            while self._room > 0 and (asked := self._wanted()) is not None:
                self._out[self._next_index] = asked
                self._next_index += 1
                found.append(asked)
            if found or any(asked.direction != NONE for asked in self._out.values()):
                break
            if not self._lower():  # all directions were tried, with steps that were known already
                break
        return found

    def unwanted(self) -> tuple[int, ...]:
        """What is to be taken back; at the end, all that is outstanding."""
        if self.ending is not None:
            self._unwanted += self._out
            self._out.clear()
        found, self._unwanted = tuple(self._unwanted), []
        return found

    def receive(self, evaluations: list[Evaluation]) -> None:
        """Learn what has come back, and move, shorten steps, or begin another poll."""
        state = self._state
        numbers = {self._learn(evaluation): evaluation.index for evaluation in evaluations}
        meshes = {number: self._out.pop(index).mesh for number, index in numbers.items()}
        if state.satisfied:
            self.ending = Ending.CONVERGED
            return
        if not state.calibrated:
            if len(state.polled) > len(state.u):
                self._calibrate()
            return
        better = state.better(list(numbers))
        if better is not None:
            length = state.move(better)
            mesh = stepped(self._options, meshes[better], length)
            self._begin(max(mesh, state.tolerance))
            self._note(length)
            return
        self._pass_slow_points()
        self._lower()

    @property
    def _late(self) -> int:
        """A point that so many others have overtaken is slow: nothing waits for it any more."""
        return len(self._state.u)

    @property
    def _room(self) -> int:
        """How many more may be asked for; slow ones do not count, they wait in no queue."""
        return self._most - sum(asked.overtaken < self._late for asked in self._out.values())

    def _calibrate(self) -> bool:
        """Choose the penalty and begin again with it; whether that could be done."""
        self._state.calibrate()
        self._begin(self._mesh)
        return self._state.calibrated

    def _learn(self, evaluation: Evaluation) -> int:
        """Remember an answer; the number of its point."""
        asked = self._out[evaluation.index]
        if asked.direction != NONE:
            self._shorten(asked.direction)
        for index, other in self._out.items():
            other.overtaken += index < evaluation.index
        self._newest = max(self._newest, evaluation.index)
        self._answered += 1
        return self._state.learn(asked.u, evaluation)

    def _begin(self, mesh: float) -> None:
        """Begin a poll; take back what was asked for the last one and may not have begun.

        Points begin in their order. One that was asked for before another that has come back is
        under way, and may still turn out to be the best.
        """
        self._forget([index for index in self._out if index > self._newest])
        for asked in self._out.values():
            asked.direction = NONE
        self._mesh = mesh
        self._ahead = self._state.ahead(mesh)
        self._steps = np.full(len(self._ahead.directions), mesh)
        self._due = deque(range(len(self._steps)))
        self._promising = deque(self._ahead.promising)
        self._scattered = deque(self._ahead.scattered)

    def _lower(self) -> bool:
        """Go on with a finer mesh if every direction has been tried with this one; whether it has.

        Before the end everything that was asked for must be known: it could be better.
        """
        largest = float(self._steps.max(initial=0.0))
        if largest >= self._mesh:
            return False
        mesh = min(largest, shrunk(self._options, self._mesh, self._ahead))
        finished = mesh < self._state.tolerance
        if finished and self._out and self._state.tolerance <= self._options.mesh_tolerance:
            return False
        if not self._state.calibrated and self._calibrate():
            return True
        self._state.fail()
        if finished:
            self.ending, mesh = self._state.settle()
        if self.ending is None:
            self._begin(mesh)
        self._note(0.0)
        return True

    def _wanted(self) -> RequestedPoint | None:
        """The next point worth asking for, if any."""
        out = {key(asked.u): asked for asked in self._out.values()}
        while True:
            asked = self._candidate()
            if asked is None:
                return None
            twin = out.get(key(asked.u))
            if twin is None:
                return asked
            if twin.direction == NONE:
                twin.direction = asked.direction
            elif asked.direction != NONE:
                self._shorten(asked.direction)

    def _candidate(self) -> RequestedPoint | None:
        """The next point worth asking for, which may have been asked for already."""
        while True:
            if self._promising:
                return RequestedPoint(self._promising.popleft(), self._mesh)
            if self._due:
                found = self._in_direction(self._due.popleft())
                if found is not None:
                    return found
            elif self._scattered:
                return RequestedPoint(self._scattered.popleft(), self._mesh)
            else:
                return None

    def _in_direction(self, direction: int) -> RequestedPoint | None:
        """The point to ask for in a direction; None where it is known or its step is too short."""
        step = float(self._steps[direction])
        if step < self._state.tolerance:
            return None
        candidate = self._state.u + step * self._ahead.directions[direction]
        found = self._state.new([candidate], self._ahead.slopes)
        if not len(found):
            self._shorten(direction)
            return None
        return RequestedPoint(found[0], step, direction)

    def _shorten(self, direction: int) -> None:
        self._steps[direction] *= self._options.contraction
        self._due.append(direction)

    def _pass_slow_points(self) -> None:
        """Go on in directions whose point is slow; it still counts once it is there."""
        for asked in self._out.values():
            if asked.direction != NONE and asked.overtaken >= self._late:
                self._shorten(asked.direction)
                asked.direction = NONE

    def _forget(self, indices: list[int]) -> None:
        for index in indices:
            del self._out[index]
        self._unwanted += indices

    def _note(self, length: float) -> None:
        iteration = self._answered // (2 * len(self._state.u))
        self.progress = progress_of(self._state, iteration, self._mesh, length)
