"""A search in progress: its requested points, their outcomes and its evaluations.

Several searches may wait for the same task. A simulation is not requested twice while it is in
progress or its outcome is cached.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
    """Return the evaluation of a point from the outcomes of its experiments.

    Parameters
    ----------
    space, x
        The space and the point.
    outcomes
        One outcome for each experiment of the space, in their order, with its priors.
    index
        Number of the point among all points of its search.
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
    """Return the outcome of an experiment with the residuals of its priors.

    The residuals of priors depend only on the point. Logs and workers do not contain them.
    """
    if not outcome.ok or not len(space.priors.places[e]):
        return outcome
    known = np.zeros(0) if outcome.residuals is None else outcome.residuals
    return replace(outcome, residuals=np.concatenate([known, space.priors.residuals(e, x)]))


def violation(constraints: FloatArray, equality: npt.NDArray[np.bool_]) -> float:
    """Return the largest violation; 0 if all are satisfied, infinite if a value is undefined."""
    if np.isnan(constraints).any():
        return np.inf
    sizes = np.where(equality, np.abs(constraints), np.maximum(constraints, 0.0))
    return float(sizes.max(initial=0.0))


MEMORY_BYTES = 256 * 2**20
"""Size of the cache of outcomes, which avoids repeated simulations."""
OUTCOME_BYTES = 800
"""Size of a cached outcome without its residuals."""

MOST_NAMED_VALUES = 1000
"""Largest number of unknowns for which the iteration table has the values of the best point."""

Question = tuple[int, bytes, tuple[Effect, ...], Want, float, int]
"""Key of a simulation: experiment, values, effects, wanted result, bound of the early end, and step
limit.

An outcome answers only questions with the same wanted result, bound and limit. Otherwise the bits
of a result would depend on the order of the simulations."""


@dataclass(frozen=True)
class SearchRequest:
    """A request to search a space with a method.

    `name` identifies the search in the log. `seed` is the seed of the method's random generator.
    `step_limits` has the step limits of simulations by experiment; see `Task`.
    """

    name: str
    method: Method
    space: SearchSpace
    seed: int = 0
    step_limits: Mapping[int, int] = field(default_factory=dict)


def suited(space: SearchSpace, method: Method) -> SearchSpace:
    """Return the space for a method: reduced, unless the method needs every residual."""
    return space if method.needs_every_residual else replace(space, reduced=True)


@dataclass
class PendingPoint:
    """A requested point, and its outcomes so far."""

    index: int
    x: FloatArray
    outcomes: list[Outcome | None]
    missing: int


@dataclass
class SearchState:
    """A search in progress, with its pending points by index."""

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
        """True if the search can go on with the evaluations so far."""
        if self.asynchronous:
            return bool(self.answers) or not self.pending
        return not self.pending

    def expect(self, points: Points) -> int:
        """Register points as pending; return the index of the first point."""
        self.asynchronous, self.purpose = points.asynchronous, points.purpose
        self.sensitivities = points.sensitivities
        first, count = self.asked, len(self.request.space.experiments)
        self.asked += len(points.x)
        self.requested = len(points.x)
        for p, x in enumerate(points.x):
            self.pending[first + p] = PendingPoint(first + p, x.copy(), [None] * count, count)
        return first

    def place(self, index: int, e: int, outcome: Outcome) -> None:
        """Store the outcome of a pending point's experiment; evaluate the point if complete."""
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
        """Return the new evaluations for the search, in the order of its requests."""
        answers = sorted(self.answers, key=lambda answer: answer[0].index)
        self.answers = []
        for evaluation, x in answers:
            if evaluation.ok and (self.best is None or evaluation.rank < self.best.rank):
                self.best, self.best_x = evaluation, x
        return [evaluation for evaluation, _ in answers]

    def cut_short(self, ending: Ending) -> None:
        """End the search with the best point so far, or with the start if there is none."""
        x = self.request.space.start if self.best_x is None else self.best_x
        cost = np.nan if self.best is None else self.best.cost
        self.solution = Solution(x, cost, ending, iterations=self.progress.iteration, at=self.best)
        self.pending.clear()

    def best_point(self) -> BestPoint | None:
        """Return the best point so far; None if there is none or it has too many unknowns."""
        best, space = self.best, self.request.space
        if best is None or self.best_x is None or space.size > MOST_NAMED_VALUES:
            return None
        violation = 0.0 if best.feasible else best.violation
        return BestPoint(best.cost, violation, space.estimates(self.best_x))

    def last_line(self) -> Progress | None:
        """Return the last line of the iteration table; None if the search has not ended."""
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
"""The destination of an outcome: search, index of the point, position of the experiment."""


class _AskedTask(NamedTuple):
    """A requested task and its question."""

    origin: TaskOrigin
    question: Question


class PendingTasks:
    """The tasks of all searches, between the searches and an executor.

    Parameters
    ----------
    executor
        The executor that runs the tasks.
    record
        Called once for each simulation, in the order in which they end.

    Attributes
    ----------
    simulations, failures
        Number of simulations and of failed simulations.
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
        """Neither record nor count simulations that end within this context."""
        record, before = self._record, (self.simulations, self.failures)
        self._record = lambda *_: None
        try:
            yield
        finally:
            self._record = record
            self.simulations, self.failures = before

    @property
    def under_way(self) -> int:
        """Number of tasks without an outcome."""
        return len(self._under_way)

    def task(
        self,
        name: str,
        want: Want,
        experiment: int,
        values: FloatArray,
        effects: tuple[Effect, ...],
    ) -> Task:
        """Return a new task for a simulation outside any search; the caller submits it."""
        return self._make(
            (experiment, values.tobytes(), effects, want, np.inf, 0), values, name, 0, want
        )

    def _make(
        self, question: Question, values: FloatArray, name: str, index: int, purpose: str
    ) -> Task:
        experiment, _, effects, want, bound, limit = question
        task = Task(self._next_task, experiment, values, want, effects, bound, limit)
        self._next_task += 1
        self._under_way[task.id] = _AskedTask(TaskOrigin(task, name, index, purpose), question)
        return task

    def request(self, search: SearchState, points: Points) -> Iterator[Task]:
        """Yield the tasks of a search's next points.

        There is no task for cached outcomes and for simulations that another search requested.
        """
        space = search.request.space
        first = search.expect(points)
        bounds = _bounds(space, points).tolist()
        values = [space.physical(x) for x in points.x]
        finite = [np.asarray(np.isfinite(each).all(axis=1)) for each in values]
        places = [(p, e) for e in range(len(space.experiments)) for p in range(len(points.x))]
        if points.asynchronous:  # simulate point by point, so that points are complete early
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
        """Return a new task for a slot; None if the outcome is cached or already requested."""
        search, index, place = slot
        space = search.request.space
        effects, want = space.problem.effects, space.wants[place]
        want = "sensitivities" if search.sensitivities else want
        limit = search.request.step_limits.get(experiment, 0)
        question = (experiment, values.tobytes(), effects, want, bound, limit)
        if (known := self._known.get(question)) is not None:
            _place(slot, known)
            return None
        if question in self._waiting:
            self._waiting[question].append(slot)
            return None
        self._waiting[question] = [slot]
        return self._make(question, values, search.request.name, index, search.purpose)

    def receive(self, outcome: Outcome) -> Iterator[SearchState]:
        """Fill the slots that wait for an outcome; yield the search of each filled slot."""
        asked = self._under_way.get(outcome.task)
        if asked is None:
            return
        outcome, question = self.note(outcome), asked.question
        self._remember(question, outcome)
        for slot in self._waiting.pop(question, []):
            _place(slot, outcome)
            yield slot[0]

    def _remember(self, question: Question, outcome: Outcome) -> None:
        """Cache an outcome; clear the cache before if it would become too large."""
        kept = (outcome.residuals, outcome.sensitivities)
        size = OUTCOME_BYTES + sum(0 if each is None else each.nbytes for each in kept)
        if self._known_bytes + size > MEMORY_BYTES:
            self.forget()
        self._known[question] = outcome
        if outcome.ok:  # without a step limit, its bits would be the same
            self._known[(*question[:-1], 0)] = outcome
        self._known_bytes += size

    def forget(self) -> None:
        """Clear the cache of outcomes."""
        self._known.clear()
        self._known_bytes = 0

    def note(self, outcome: Outcome) -> Outcome:
        """Count and record the outcome of a task; return it, or a failure if its size is wrong."""
        origin = self._under_way.pop(outcome.task).origin
        if outcome.residuals is not None:
            found = len(outcome.residuals)
            kind = origin.task.experiment, origin.task.want in REDUCTIONS
            wanted = self._sizes.setdefault(kind, found)
            if found != wanted:  # from a user's function, on a worker without an earlier point
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
        """Cancel tasks that no search needs any more and that have not begun."""
        unwanted = {
            question
            for question, slots in self._waiting.items()
            if not any(index in owner.pending for owner, index, _ in slots)
        }
        self._cancel([t for t, asked in self._under_way.items() if asked.question in unwanted])

    def drop_all(self) -> None:
        """Cancel all tasks that have not begun."""
        self._cancel(list(self._under_way))

    def _cancel(self, tasks: list[int]) -> None:
        for task in self._executor.cancel(tasks):
            self._waiting.pop(self._under_way.pop(task).question, None)


def _place(slot: Slot, outcome: Outcome) -> None:
    search, index, e = slot
    search.place(index, e, outcome)


def _bounds(space: SearchSpace, points: Points) -> FloatArray:
    """Return the sums of squares (points,) above which a simulation may end early.

    Other experiments and priors add nonnegative terms to the cost. So a simulation may end if the
    sum of squares of its experiment alone exceeds the bound of the cost.
    """
    if points.bounds is None or not isinstance(space.problem.cost, SumSquared):
        return np.full(len(points.x), np.inf)
    return points.bounds


def _no_values(space: SearchSpace, values: FloatArray) -> Outcome:
    """Return the outcome of a point at which the value of a parameter is not finite."""
    named = [p.name for p in space.problem.parameters if not p.auxiliary]
    first = int(np.flatnonzero(~np.isfinite(values))[0])
    return Outcome(
        -1,
        Status.NOT_FINITE,
        message=f"parameter {named[first]!r} is {values[first]}, so nothing was simulated",
    )
