"""A pattern search that never waits for the slowest simulation.

Every direction of the poll has a step of its own. As soon as a point is better than the one that
is polled around, the search moves there, and what was asked around the old one and has not begun is
taken back; a direction in which a point was no better is tried again with a smaller step, whatever
the others do. P. D. Hough, T. G. Kolda, V. J. Torczon, Asynchronous parallel pattern search for
nonlinear optimization, SIAM J. Sci. Comput. 23 (2001) 134-156, doi:10.1137/S1064827599365823; with
one coordinator, T. G. Kolda, SIAM J. Optim. 16 (2005) 563-586, doi:10.1137/040603589.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Method, Points, Progress, Search, Solution
from cluster_est.methods.pattern_search import (
    check_contraction,
    progress_of,
    shrunk,
    solution_of,
    stepped,
)
from cluster_est.methods.pattern_state import PatternOptions, PatternState, SearchStep
from cluster_est.methods.patterns import Axes, Basis
from cluster_est.methods.polled import key
from cluster_est.space import Space
from workers.messages import FloatArray

NONE = -1


@dataclass(frozen=True)
class AsynchronousPatternSearch(Method):
    """Pattern search that uses each simulation as soon as it ends.

    For simulations that take very different times, as with adaptive solvers or machines that others
    use too, and many workers: the slowest holds up nothing. Where all take equally long,
    `pattern_search` does the same with fewer evaluations. What it finds depends on the order in
    which simulations end, so a run cannot be repeated exactly.

    Attributes
    ----------
    outstanding
        How many points are asked for and not answered at any time; 0 for twice the number of
        unknowns. More than there are workers: those that wait fill gaps.
    basis, axes, search_step, search_points, initial_mesh, mesh_tolerance, expansion, contraction
        As in `pattern_search`, for each direction on its own.
    max_iterations
        Limit on the evaluations, in polls of twice the number of unknowns.
    """

    name: ClassVar[str] = "asynchronous_pattern_search"
    needs_residuals: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = True

    outstanding: int = field(default=0, metadata={"least": 0})
    basis: Basis = "2n"
    axes: Axes = "aligned"
    search_step: SearchStep = "quadratic"
    search_points: int = field(default=0, metadata={"least": 0})
    initial_mesh: float = field(default=0.25, metadata={"least": 1e-9})
    mesh_tolerance: float = field(default=1e-6, metadata={"least": 1e-10})
    expansion: float = field(default=2.0, metadata={"least": 1.0})
    contraction: float = field(default=0.5, metadata={"least": 0.01})
    max_iterations: int = field(default=1000, metadata={"least": 1})

    def check(self, space: Space) -> None:
        check_contraction(self.contraction)

    def search(self, space: Space, generator: np.random.Generator) -> Search:
        (at,) = yield Points(space.start[None, :], "start", Progress(0, np.nan))
        if not at.ok:
            return Solution(space.start, np.nan, Ending.START_FAILED, at.reason)
        state = PatternState(space, self, generator, at)
        course = _Course(state, self, self.outstanding or 2 * space.size)
        while True:
            asked = course.next()
            drop = course.unwanted()
            if course.ending is not None:
                break
            x = np.array([state.frame.x(point.u) for point in asked]).reshape(-1, space.size)
            answers = yield Points(x, "poll", course.progress, asynchronous=True, drop=drop)
            course.receive(answers)
            if course.progress.iteration >= self.max_iterations and course.ending is None:
                course.ending = Ending.MAX_ITERATIONS
        if drop:
            nothing = np.zeros((0, space.size))
            yield Points(nothing, "poll", course.progress, asynchronous=True, drop=drop)
        return solution_of(state, course.ending, course.progress.iteration)


@dataclass
class _Asked:
    """A point that was asked for.

    Attributes
    ----------
    u, mesh
        Where, and how large the step was.
    direction
        Of the poll that is under way, if that waits for it, or NONE.
    stray
        Whether it was asked for another poll, or is not waited for any more.
    overtaken
        How many points that were asked for later have come back.
    """

    u: FloatArray
    mesh: float
    direction: int = NONE
    stray: bool = False
    overtaken: int = 0


class _Course:
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

    def __init__(self, state: PatternState, options: PatternOptions, most: int) -> None:
        self._state = state
        self._options = options
        self._most = most
        self._out: dict[int, _Asked] = {}
        self._unwanted: list[int] = []
        self._next_index = 1  # the start was 0
        self._newest = 0
        self._answered = 0
        self.ending = Ending.CONVERGED if state.satisfied else None
        self.progress = progress_of(state, 0, options.initial_mesh, np.nan)
        self._begin(options.initial_mesh)

    def next(self) -> list[_Asked]:
        """What to ask for now; nothing if it is time to wait, or at the end."""
        found: list[_Asked] = []
        while self.ending is None:
            self._forget_strays()
            while len(self._out) < self._most:
                asked = self._wanted()
                if asked is None:
                    break
                self._out[self._next_index] = asked
                self._next_index += 1
                found.append(asked)
            if found or any(asked.direction != NONE for asked in self._out.values()):
                break
            self._lower()  # all directions were tried, with steps that were known already
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
                state.calibrate()
                self._begin(self._mesh)
            return
        better = state.better(list(numbers))
        if better is not None:
            length = state.move(better)
            mesh = stepped(self._options, meshes[better], length)
            self._begin(max(mesh, state.tolerance))
            self._note(length)
            return
        self._overtake(len(state.u))
        self._lower()

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
            asked.direction, asked.stray = NONE, True
        self._mesh = mesh
        self._ahead = self._state.ahead(mesh)
        self._steps = np.full(len(self._ahead.directions), mesh)
        self._due = deque(range(len(self._steps)))
        self._promising = deque(self._ahead.promising)
        self._scattered = deque(self._ahead.scattered)

    def _lower(self) -> None:
        """Go on with a finer mesh if every direction has been tried with this one."""
        largest = float(self._steps.max(initial=0.0))
        if largest >= self._mesh:
            return
        mesh = min(largest, shrunk(self._options, self._mesh, self._ahead))
        self._state.fail()
        if mesh < self._state.tolerance:
            self.ending, mesh = self._state.settle()
        if self.ending is None:
            self._begin(mesh)
        self._note(0.0)

    def _wanted(self) -> _Asked | None:
        """The next point worth asking for, if any."""
        known = {key(asked.u) for asked in self._out.values()}
        while True:
            if self._promising:
                asked = _Asked(self._promising.popleft(), self._mesh)
            elif self._due:
                found = self._in_direction(self._due.popleft())
                if found is None:
                    continue
                asked = found
            elif self._scattered:
                asked = _Asked(self._scattered.popleft(), self._mesh)
            elif self._overtake(0):  # there is room, so nobody need wait
                continue
            else:
                return None
            if key(asked.u) not in known:
                return asked
            if asked.direction != NONE:
                self._shorten(asked.direction)

    def _in_direction(self, direction: int) -> _Asked | None:
        """The point to ask for in a direction; None where it is known or its step is too short."""
        step = float(self._steps[direction])
        if step < self._state.tolerance:
            return None
        candidate = self._state.u + step * self._ahead.directions[direction]
        found = self._state.new([candidate], self._ahead.slopes)
        if not len(found):
            self._shorten(direction)
            return None
        return _Asked(found[0], step, direction)

    def _shorten(self, direction: int) -> None:
        self._steps[direction] *= self._options.contraction
        self._due.append(direction)

    def _overtake(self, patience: int) -> bool:
        """Go on in directions whose point was overtaken by so many; whether there are any."""
        late = [a for a in self._out.values() if a.direction != NONE and a.overtaken >= patience]
        for asked in late:
            self._shorten(asked.direction)
            asked.direction, asked.stray = NONE, True
        return bool(late)

    def _forget_strays(self) -> None:
        """Keep half of the room for the present poll, whatever hangs."""
        strays = [index for index, asked in self._out.items() if asked.stray]
        strays.sort(key=lambda index: self._out[index].overtaken)
        self._forget(strays[max(1, self._most // 2) :])

    def _forget(self, indices: list[int]) -> None:
        for index in indices:
            del self._out[index]
        self._unwanted += indices

    def _note(self, length: float) -> None:
        iteration = self._answered // (2 * len(self._state.u))
        self.progress = progress_of(self._state, iteration, self._mesh, length)
