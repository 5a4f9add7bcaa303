"""Tasks that were asked for: which searches wait for each, and the cache of outcomes.

The same simulation is never asked for twice while it is under way or remembered.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.executors.base import Executor
from cluster_est.methods.method import Points
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.records import Record, TaskOrigin
from cluster_est.running.search_state import OutcomeCache, Question, SearchState
from workers.messages import REDUCTIONS, Effect, FloatArray, Outcome, Status, Task, Want

Slot = tuple[SearchState, int, int]
"""A search, the index of its point, and the position of the experiment: where an outcome goes."""


class _Asked(NamedTuple):
    """A task that was asked for, and what it answers."""

    origin: TaskOrigin
    question: Question


class PendingTasks:
    """Stands between searches and an executor.

    Parameters
    ----------
    executor
        Where tasks run.
    record
        Called once for each simulation, in the order in which they end.

    Attributes
    ----------
    simulations, failures
        How many there were.
    """

    def __init__(self, executor: Executor, record: Record) -> None:
        self._executor = executor
        self._record = record
        self._next_task = 0
        self._under_way: dict[int, _Asked] = {}
        self._waiting: dict[Question, list[Slot]] = {}
        self._known = OutcomeCache()
        self._sizes: dict[tuple[int, bool], int] = {}
        self.simulations = 0
        self.failures = 0

    @property
    def under_way(self) -> int:
        """Tasks that were made and have not been answered."""
        return len(self._under_way)

    def task(
        self,
        name: str,
        want: Want,
        experiment: int,
        values: FloatArray,
        effects: tuple[Effect, ...],
    ) -> Task:
        """A new task for a simulation outside any search; the caller submits it."""
        return self._make(
            (experiment, values.tobytes(), effects, want, np.inf), values, name, 0, want
        )

    def _make(
        self, question: Question, values: FloatArray, name: str, index: int, purpose: str
    ) -> Task:
        experiment, _, effects, want, bound = question
        task = Task(self._next_task, experiment, values, want, effects, bound)
        self._next_task += 1
        self._under_way[task.id] = _Asked(TaskOrigin(task, name, index, purpose), question)
        return task

    def request(self, search: SearchState, points: Points) -> Iterator[Task]:
        """Give the tasks of a search's next points, experiment by experiment.

        What is known already, or asked for by another search, takes no task.
        """
        space = search.request.space
        first = search.expect(points)
        bounds = _bounds(space, points).tolist()
        values = [space.physical(x) for x in points.x]
        finite = [np.asarray(np.isfinite(each).all(axis=1)) for each in values]
        places = [(p, e) for e in range(len(space.experiments)) for p in range(len(points.x))]
        if points.asynchronous:  # a point is answered when it is complete, so one after the other
            places.sort()
        for p, e in places:
            slot = search, first + p, e
            if not finite[p][e]:
                _place(slot, _no_values(space, values[p][e]))
                continue
            task = self._ask(slot, space.experiments[e], values[p][e], bounds[p])
            if task is not None:
                yield task

    def _ask(self, slot: Slot, experiment: int, values: FloatArray, bound: float) -> Task | None:
        """Make a task for what is not known and nobody has asked for; else fill the slot."""
        search, index, place = slot
        space = search.request.space
        effects, want = space.problem.effects, space.wants[place]
        want = "sensitivities" if search.sensitivities else want
        question = (experiment, values.tobytes(), effects, want, bound)
        if (known := self._known.get(question)) is not None:
            _place(slot, known)
            return None
        if question in self._waiting:
            self._waiting[question].append(slot)
            return None
        self._waiting[question] = [slot]
        return self._make(question, values, search.request.name, index, search.purpose)

    def receive(self, outcome: Outcome) -> Iterator[SearchState]:
        """Fill the slots that wait for an outcome, one by one; after each, whose it was."""
        asked = self._under_way.get(outcome.task)
        if asked is None:
            return
        outcome, question = self.note(outcome), asked.question
        self._known.remember(question, outcome)
        for slot in self._waiting.pop(question, []):
            _place(slot, outcome)
            yield slot[0]

    def note(self, outcome: Outcome) -> Outcome:
        """Count and record the outcome of a task; what it is taken for."""
        origin = self._under_way.pop(outcome.task).origin
        if outcome.residuals is not None:
            found = len(outcome.residuals)
            kind = origin.task.experiment, origin.task.want in REDUCTIONS
            wanted = self._sizes.setdefault(kind, found)
            if found != wanted:  # of a user's function, on a worker that saw no other point yet
                message = f"there are {found} residuals but there were {wanted} at the first point"
                seconds, worker = outcome.seconds, outcome.worker
                outcome = Outcome(
                    outcome.task, Status.NOT_FINITE, message=message, seconds=seconds, worker=worker
                )
        self.simulations += 1
        self.failures += outcome.failed
        self._record(origin, outcome)
        return outcome

    def drop_unwanted(self) -> None:
        """Take back what no search waits for any more and no worker has begun."""
        unwanted = {
            question
            for question, slots in self._waiting.items()
            if not any(index in owner.pending for owner, index, _ in slots)
        }
        self._cancel([t for t, asked in self._under_way.items() if asked.question in unwanted])

    def drop_all(self) -> None:
        """Take back all that no worker has begun."""
        self._cancel(list(self._under_way))

    def _cancel(self, tasks: list[int]) -> None:
        for task in self._executor.cancel(tasks):
            self._waiting.pop(self._under_way.pop(task).question, None)


def _place(slot: Slot, outcome: Outcome) -> None:
    search, index, e = slot
    search.place(index, e, outcome)


def _bounds(space: SearchSpace, points: Points) -> FloatArray:
    """Return the sums of squares (points,) above which no experiment need be simulated further.

    What other experiments and priors add to a cost is not negative, so that a sum of one
    experiment that is above the bound of the cost is enough.
    """
    if points.bounds is None or not isinstance(space.problem.cost, SumSquared):
        return np.full(len(points.x), np.inf)
    return points.bounds


def _no_values(space: SearchSpace, values: FloatArray) -> Outcome:
    """The outcome of a point at which a parameter has no value."""
    named = [p.name for p in space.problem.parameters if not p.auxiliary]
    first = int(np.flatnonzero(~np.isfinite(values))[0])
    return Outcome(
        -1,
        Status.NOT_FINITE,
        message=f"parameter {named[first]!r} is {values[first]}, so nothing was simulated",
    )
