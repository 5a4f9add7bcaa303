"""A search in progress: what it has asked for, what has come back, and what it is sent.

Several searches may wait for the same task: a simulation is never asked for twice while it is under
way or remembered.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cluster_est.executors.executor import Executor
from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
    joined_residuals,
)
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.resources import BestPoint, Record, SearchIteration, TaskOrigin
from workers.messages import REDUCTIONS, Effect, FloatArray, Outcome, Status, Task, Want


def assemble_evaluation(
    space: SearchSpace, x: FloatArray, outcomes: tuple[Outcome, ...], index: int
) -> Evaluation:
    """Join the outcomes of a point's experiments, which stand in their order.

    Parameters
    ----------
    space, x
        Where the point lies.
    outcomes
        One for each experiment of the space, with its priors.
    index
        The number of the point among all that its search has asked for.
    """
    if not all(outcome.ok for outcome in outcomes):
        return Evaluation(outcomes, np.nan, violation=np.nan, index=index)
    cost = space.problem.cost.value(joined_residuals(outcomes), space.outputs)
    if not space.constraint_names:
        return Evaluation(outcomes, cost, index=index)
    parts = [space.parameter_constraints(x), *(outcome.constraints for outcome in outcomes)]
    constraints = np.concatenate(parts)
    return Evaluation(outcomes, cost, constraints, violation(constraints, space.equality), index)


def with_priors(space: SearchSpace, x: FloatArray, e: int, outcome: Outcome) -> Outcome:
    """Return the outcome of an experiment with the residuals of the priors that count with it.

    They stand in no log and come from no worker: they follow from the point alone.
    """
    if not outcome.ok or not len(space.priors.places[e]):
        return outcome
    known = np.zeros(0) if outcome.residuals is None else outcome.residuals
    return replace(outcome, residuals=np.concatenate([known, space.priors.residuals(e, x)]))


def violation(constraints: FloatArray, equality: npt.NDArray[np.bool_]) -> float:
    """The largest violation; 0 where all are satisfied, infinite where one has no value."""
    if np.isnan(constraints).any():
        return np.inf
    sizes = np.where(equality, np.abs(constraints), np.maximum(constraints, 0.0))
    return float(sizes.max(initial=0.0))


MEMORY_BYTES = 256 * 2**20
"""What is remembered to answer repeated questions without simulating."""
OUTCOME_BYTES = 800
"""What an outcome takes besides its residuals."""

MOST_NAMED_VALUES = 1000
"""Unknowns up to which the values of the best point go into each line of a search's table."""

Question = tuple[int, bytes, tuple[Effect, ...], Want, float]
"""Experiment, values and effects, which make a simulation, what is wanted of it, and the bound
above which it ends early: whole residuals never stand in for reduced ones, nor one bound for
another, or bits would depend on which of them came first."""


@dataclass(frozen=True)
class SearchRequest:
    """One search: a method let loose on a space.

    `name` tells searches apart in the log; `seed` starts the method's random generator.
    """

    name: str
    method: Method
    space: SearchSpace
    seed: int = 0


def suited(space: SearchSpace, method: Method) -> SearchSpace:
    """The space as a method is given it: reduced, unless it looks at single residuals."""
    return space if method.needs_every_residual else replace(space, reduced=True)


@dataclass
class PendingPoint:
    """A point that was asked for, and the outcomes that are there already."""

    index: int
    x: FloatArray
    outcomes: list[Outcome | None]
    missing: int


@dataclass
class SearchState:
    """A search in progress and the points that it waits for, by index."""

    request: SearchRequest
    steps: Search
    pending: dict[int, PendingPoint] = field(default_factory=dict)
    answers: list[tuple[Evaluation, FloatArray]] = field(default_factory=list)
    asynchronous: bool = False
    purpose: str = ""
    sensitivities: bool = False
    asked: int = 0
    requested: int = 0
    best: Evaluation | None = None
    best_x: FloatArray | None = None
    progress: Progress = field(default_factory=lambda: Progress(0, np.nan))
    solution: Solution | None = None
    counts: bool = True
    lines: list[SearchIteration] = field(default_factory=list)

    @property
    def ready(self) -> bool:
        """True where all that it waits for is there."""
        if self.asynchronous:
            return bool(self.answers) or not self.pending
        return not self.pending

    def expect(self, points: Points) -> int:
        """Wait for points from now on, and return the index of the first of them."""
        self.asynchronous, self.purpose = points.asynchronous, points.purpose
        self.sensitivities = points.sensitivities
        first, count = self.asked, len(self.request.space.experiments)
        self.asked += len(points.x)
        self.requested = len(points.x)
        for p, x in enumerate(points.x):
            self.pending[first + p] = PendingPoint(first + p, x.copy(), [None] * count, count)
        return first

    def place(self, index: int, e: int, outcome: Outcome) -> None:
        """Put an outcome where it is waited for; evaluate the point that it completes."""
        point = self.pending.get(index)
        if point is None:  # dropped, or the search has ended
            return
        space, x = self.request.space, point.x
        if space.continuity is not None and outcome.ok and outcome.residuals is not None:
            joined = space.continuity.applied(e, x, outcome.residuals)
            outcome = replace(outcome, residuals=joined)
        point.outcomes[e] = with_priors(space, x, e, outcome)
        point.missing -= 1
        if point.missing == 0:
            del self.pending[index]
            outcomes = tuple(o for o in point.outcomes if o is not None)
            self.answers.append((assemble_evaluation(space, x, outcomes, index), x))

    def take_answers(self) -> list[Evaluation]:
        """The evaluations that it is sent, in the order in which it asked for them."""
        answers = sorted(self.answers, key=lambda answer: answer[0].index)
        self.answers = []
        for evaluation, x in answers:
            if evaluation.ok and (self.best is None or evaluation.rank < self.best.rank):
                self.best, self.best_x = evaluation, x
        return [evaluation for evaluation, _ in answers]

    def cut_short(self, ending: Ending) -> None:
        """End with the best point so far, or with the start without such a point."""
        x = self.request.space.start if self.best_x is None else self.best_x
        cost = np.nan if self.best is None else self.best.cost
        self.solution = Solution(x, cost, ending, iterations=self.progress.iteration, at=self.best)
        self.pending.clear()

    def best_point(self) -> BestPoint | None:
        """Return the best point so far, for those who watch."""
        best, space = self.best, self.request.space
        if best is None or self.best_x is None or space.size > MOST_NAMED_VALUES:
            return None
        violation = 0.0 if best.feasible else best.violation
        return BestPoint(best.cost, violation, space.estimates(self.best_x))

    def last_line(self) -> Progress | None:
        """Return how it ended, as a line of its table; None if it has not."""
        solution = self.solution
        if solution is None:
            return None
        violation = np.nan
        if self.request.space.constraint_names and solution.at is not None:
            violation = solution.at.violation
        return replace(
            self.progress,
            iteration=solution.iterations,
            cost=solution.cost,
            violation=violation,
            ending=solution.ending.name.lower(),
        )


Slot = tuple[SearchState, int, int]
"""A search, the index of its point, and the position of the experiment: where an outcome goes."""


class _AskedTask(NamedTuple):
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
        self._under_way: dict[int, _AskedTask] = {}
        self._waiting: dict[Question, list[Slot]] = {}
        self._known: dict[Question, Outcome] = {}
        self._known_bytes = 0
        self._sizes: dict[tuple[int, bool], int] = {}
        self.simulations = 0
        self.failures = 0

    @contextmanager
    def uncounted(self) -> Iterator[None]:
        """Record and count nothing of what ends here."""
        record, before = self._record, (self.simulations, self.failures)
        self._record = lambda *_: None
        try:
            yield
        finally:
            self._record = record
            self.simulations, self.failures = before

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
        self._under_way[task.id] = _AskedTask(TaskOrigin(task, name, index, purpose), question)
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
        self._remember(question, outcome)
        for slot in self._waiting.pop(question, []):
            _place(slot, outcome)
            yield slot[0]

    def _remember(self, question: Question, outcome: Outcome) -> None:
        """Keep what answers a repeated question without simulating, up to a size."""
        kept = (outcome.residuals, outcome.sensitivities)
        size = OUTCOME_BYTES + sum(0 if each is None else each.nbytes for each in kept)
        if self._known_bytes + size > MEMORY_BYTES:
            self.forget()
        self._known[question] = outcome
        self._known_bytes += size

    def forget(self) -> None:
        """Remember no answers any more."""
        self._known.clear()
        self._known_bytes = 0

    def note(self, outcome: Outcome) -> Outcome:
        """Count and record the outcome of a task; what it is taken for."""
        origin = self._under_way.pop(outcome.task).origin
        if outcome.residuals is not None:
            found = len(outcome.residuals)
            kind = origin.task.experiment, origin.task.want in REDUCTIONS
            wanted = self._sizes.setdefault(kind, found)
            if found != wanted:  # of a user's function, on a worker that saw no other point yet
                message = f"there are {found} residuals, but at the first point there were {wanted}"
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
