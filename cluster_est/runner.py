"""The only loop: it feeds many searches from one queue and joins what comes back.

Searches never wait for each other. Outcomes arrive in any order and are joined in the order of the
experiments, so a search sees the same numbers whatever the workers did.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.active import Active, Memory, Pending, Question, SearchRequest
from cluster_est.errors import BudgetError
from cluster_est.executors.base import Executor
from cluster_est.methods.base import Ending, Evaluation, Points, Progress, Solution
from cluster_est.space import Space
from workers.messages import Effect, FloatArray, Outcome, Status, Task, Want

__all__ = ["Budget", "Iteration", "Origin", "Runner", "SearchRequest", "Snapshot"]


@dataclass(frozen=True)
class Budget:
    """When to stop asking. An evaluation is one point with all its experiments."""

    evaluations: int | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Origin:
    """Who asked for a task: what the log says of it besides its outcome.

    `installed` is (id, key) of the experiment where it is none of the problem's own.
    """

    search: str
    evaluation: int
    purpose: str
    experiment: int
    values: FloatArray
    effects: tuple[Effect, ...] = ()
    installed: tuple[str, str] | None = None


@dataclass(frozen=True)
class Snapshot:
    """What a display shows."""

    search: str
    progress: Progress
    evaluations: int
    simulations: int
    failures: int
    busy: int
    workers: int
    seconds: float


@dataclass(frozen=True)
class Iteration:
    """A line of a search's iteration table; `evaluations` are those of this search so far."""

    search: str
    progress: Progress
    evaluations: int


_Slot = tuple[Active, int, int]  # search, index of the point, position of the experiment
Record = Callable[[Origin, Outcome], None]
Show = Callable[[Snapshot], None]
Note = Callable[[Iteration], None]
Enough = Callable[[Sequence[Solution]], bool]


class Runner:
    """Runs searches on an executor.

    Parameters
    ----------
    executor
        Where tasks run; its experiments are those of the spaces' problem.
    budget
        Of all searches together.
    record
        Called once for each simulation, in the order in which they end.
    show
        Called whenever something came back.
    note
        Called for each new line of a search's iteration table, and once more at its end.
    whole
        For a recipe of many steps, to which searches that were cut short are no use: an interrupt
        goes through `run`, and a budget that is used up raises BudgetError.
    """

    def __init__(
        self,
        executor: Executor,
        budget: Budget | None = None,
        record: Record | None = None,
        show: Show | None = None,
        note: Note | None = None,
        *,
        whole: bool = False,
    ) -> None:
        self._executor = executor
        self._budget = budget or Budget()
        self._record = record or (lambda origin, outcome: None)
        self._show = show or (lambda snapshot: None)
        self._iteration = note or (lambda iteration: None)
        self._whole = whole
        self._begin = time.monotonic()
        self._next_task = 0
        self._origins: dict[int, Origin] = {}
        self._waiting: dict[Question, list[_Slot]] = {}
        self._known = Memory()
        self._sizes: dict[int, int] = {}
        self.evaluations = 0
        self.simulations = 0
        self.failures = 0

    def run(
        self,
        requests: Sequence[SearchRequest],
        at_once: int | None = None,
        enough: Enough | None = None,
    ) -> list[Solution]:
        """Run searches to their ends, all at the same time.

        A keyboard interrupt ends all of them with their best points so far, unless `whole`.

        Parameters
        ----------
        requests
            What to search.
        at_once
            How many are under way at the same time; the others begin, in order, as those end.
        enough
            Is asked, each time another one has ended before which all have ended, whether these
            first ones are all that is needed: the others are given up then. So what comes back
            does not depend on which search is faster.

        Returns
        -------
        list of Solution
            In the order of the requests; shorter than they are if there were `enough`.

        Raises
        ------
        BudgetError
            If `whole` and the budget is used up.
        """
        self._refuse_if_exhausted([])
        searches = [self._open(request) for request in requests]
        try:
            searches = self._run(searches, at_once, enough or (lambda solutions: False))
        except KeyboardInterrupt:
            if self._whole:
                raise
            for search in searches:
                if search.solution is None:
                    self._finish(search, Ending.INTERRUPTED)
        finally:
            for search in searches:
                search.steps.close()
        self._refuse_if_exhausted(searches)
        return _solutions(searches)

    def _run(self, searches: list[Active], at_once: int | None, enough: Enough) -> list[Active]:
        """Run until all have ended, or the first of them are enough; those that count."""
        waiting = searches[::-1]
        counted = 0
        while counted < len(searches):
            self._begin_searches(waiting, searches, at_once)
            if searches[counted].solution is None:
                for outcome in self._executor.completed():
                    self._receive(outcome)
                self._display(searches)
                continue
            counted += 1
            if enough(_solutions(searches[:counted])):
                self._give_up(searches[counted:])
                return searches[:counted]
        return searches

    def _begin_searches(
        self, waiting: list[Active], searches: Sequence[Active], at_once: int | None
    ) -> None:
        """Begin the next searches, in order, as many as may be under way."""
        while waiting:
            begun = len(searches) - len(waiting)
            under_way = sum(s.solution is None for s in searches[:begun])
            if at_once is not None and under_way >= at_once:
                return
            search = waiting.pop()
            if self._exhausted() and begun:
                self._finish(search, Ending.BUDGET)
            else:
                self._advance(search, None)

    def _give_up(self, searches: Sequence[Active]) -> None:
        """End searches whose solutions nobody wants any more."""
        for search in searches:
            self._drop(search, tuple(search.pending))
            search.steps.close()

    def simulate(
        self,
        values: FloatArray,
        experiments: Sequence[int],
        want: Want,
        name: str,
        effects: tuple[Effect, ...] = (),
    ) -> list[Outcome]:
        """Simulate experiments once each, outside any search.

        Parameters
        ----------
        values : (experiments, parameters)
            Physical values of the model's parameters, a row for each experiment.
        experiments
            Indices into the problem's experiments.
        want, name
            What for, and what the log calls it.
        effects
            What is added to the model.
        """
        tasks = []
        for row, experiment in zip(values, experiments, strict=True):
            origin = Origin(name, 0, want, experiment, row, effects)
            tasks.append(self._task(origin, want))
        own = {task.id for task in tasks}
        answers: dict[int, Outcome] = {}
        self._executor.submit(tasks)
        while len(answers) < len(tasks):
            for outcome in self._executor.completed():
                if outcome.task in own:
                    answers[outcome.task] = self._note(self._origins.pop(outcome.task), outcome)
                else:  # left over from a search that was ended from outside
                    self._receive(outcome)
        return [answers[task.id] for task in tasks]

    def _open(self, request: SearchRequest) -> Active:
        generator = np.random.default_rng(request.seed)
        return Active(request, request.method.search(request.space, generator))

    def _advance(self, search: Active, answers: list[Evaluation] | None) -> None:
        """Send a search its answers and queue what it asks for next."""
        while True:
            try:
                points = next(search.steps) if answers is None else search.steps.send(answers)
            except StopIteration as end:
                search.solution = end.value
                self._end(search)
                return
            if search.asked and self._exhausted():
                self._finish(search, Ending.BUDGET)
                return
            self._ask(search, points)
            if not search.ready:
                return
            answers = search.take_answers()

    def _ask(self, search: Active, points: Points) -> None:
        """Queue the tasks of a request, experiment by experiment; skip what is known already."""
        space = search.request.space
        if points.progress is not None and points.progress != search.progress:
            search.progress = points.progress
            self._iteration(Iteration(search.request.name, points.progress, search.asked))
        self._drop(search, points.drop)
        search.asynchronous, search.purpose = points.asynchronous, points.purpose
        first = search.asked
        search.asked += len(points.x)
        self.evaluations += len(points.x)
        count = len(space.experiments)
        for p, x in enumerate(points.x):
            search.pending[first + p] = Pending(first + p, x.copy(), [None] * count, count)
        physical = [space.physical(x) for x in points.x]
        places = [(p, e) for e in range(count) for p in range(len(points.x))]
        if points.asynchronous:  # a point is answered when it is complete, so one after the other
            places.sort()
        tasks: list[Task] = []
        for p, e in places:
            slot = (search, first + p, e)
            task = self._question(slot, space.experiments[e], physical[p][e])
            tasks += [task] if task is not None else []
        self._executor.submit(tasks)

    def _question(self, slot: _Slot, experiment: int, values: FloatArray) -> Task | None:
        """A task for what is not known yet and nobody has asked for."""
        search, index, _ = slot
        effects = search.request.space.problem.effects
        question = (experiment, values.tobytes(), effects)
        if not np.isfinite(values).all():
            self._place(slot, _no_values(search.request.space, values))
            return None
        if (known := self._known.get(question)) is not None:
            self._place(slot, known)
            return None
        if question in self._waiting:
            self._waiting[question].append(slot)
            return None
        self._waiting[question] = [slot]
        name, purpose = search.request.name, search.purpose
        return self._task(Origin(name, index, purpose, experiment, values, effects), "residuals")

    def _task(self, origin: Origin, want: Want) -> Task:
        task = Task(self._next_task, origin.experiment, origin.values, want, origin.effects)
        self._next_task += 1
        self._origins[task.id] = origin
        return task

    def _receive(self, outcome: Outcome) -> None:
        origin = self._origins.pop(outcome.task, None)
        if origin is None:
            return
        outcome = self._note(origin, outcome)
        question = (origin.experiment, origin.values.tobytes(), origin.effects)
        self._known.remember(question, outcome)
        for slot in self._waiting.pop(question, []):
            self._place(slot, outcome)
            search = slot[0]
            if search.ready and search.solution is None:
                self._advance(search, search.take_answers())

    def _place(self, slot: _Slot, outcome: Outcome) -> None:
        search, index, e = slot
        search.place(index, e, outcome)

    def _drop(self, search: Active, indices: tuple[int, ...]) -> None:
        """Forget points that nobody wants; those simulations that have not begun need not."""
        for index in indices:
            search.pending.pop(index, None)
        if not indices:
            return
        unwanted = {
            question
            for question, slots in self._waiting.items()
            if not any(index in owner.pending for owner, index, _ in slots)
        }
        ids = [task for task, origin in self._origins.items() if _asked(origin) in unwanted]
        for task in self._executor.cancel(ids):
            self._waiting.pop(_asked(self._origins.pop(task)), None)

    def _note(self, origin: Origin, outcome: Outcome) -> Outcome:
        """Count and record an outcome; what it is taken for."""
        if outcome.residuals is not None:
            found = len(outcome.residuals)
            wanted = self._sizes.setdefault(origin.experiment, found)
            if found != wanted:  # of a user's function, on a worker that saw no other point yet
                message = f"there are {found} residuals but there were {wanted} at the first point"
                seconds, worker = outcome.seconds, outcome.worker
                outcome = Outcome(
                    outcome.task, Status.NOT_FINITE, message=message, seconds=seconds, worker=worker
                )
        self.simulations += 1
        self.failures += not outcome.ok
        self._record(origin, outcome)
        return outcome

    def _finish(self, search: Active, ending: Ending) -> None:
        """End a search from outside, with the best point that it has seen."""
        start = search.request.space.start
        x = start if search.best_x is None else search.best_x
        cost = np.nan if search.best is None else search.best.cost
        search.solution = Solution(
            x, cost, ending, iterations=search.progress.iteration, at=search.best
        )
        search.pending.clear()
        self._end(search)

    def _end(self, search: Active) -> None:
        """Note how a search ended, as the last line of its table."""
        solution = search.solution
        if solution is None:
            return
        violation = np.nan
        if search.request.space.constraint_names and solution.at is not None:
            violation = solution.at.violation
        last = replace(
            search.progress,
            iteration=solution.iterations,
            cost=solution.cost,
            violation=violation,
            ending=solution.ending.name.lower(),
        )
        self._iteration(Iteration(search.request.name, last, search.asked))

    def _exhausted(self) -> bool:
        most, longest = self._budget.evaluations, self._budget.seconds
        used = time.monotonic() - self._begin
        return (most is not None and self.evaluations >= most) or (
            longest is not None and used >= longest
        )

    def _refuse_if_exhausted(self, searches: Sequence[Active]) -> None:
        cut = [s for s in searches if s.solution and s.solution.ending is Ending.BUDGET]
        if self._whole and self._exhausted() and (cut or not searches):
            raise BudgetError(
                f"budget: was used up after {self.evaluations} evaluations in "
                f"{time.monotonic() - self._begin:.0f} s; raise budget.evaluations or "
                "budget.seconds, or leave them out"
            )

    def _display(self, searches: Sequence[Active]) -> None:
        running = [s for s in searches if s.solution is None] or list(searches)
        self._show(
            Snapshot(
                search=running[0].request.name,
                progress=running[0].progress,
                evaluations=self.evaluations,
                simulations=self.simulations,
                failures=self.failures,
                busy=self._executor.busy,
                workers=self._executor.workers,
                seconds=time.monotonic() - self._begin,
            )
        )


def _solutions(searches: Sequence[Active]) -> list[Solution]:
    return [search.solution for search in searches if search.solution is not None]


def _asked(origin: Origin) -> Question:
    return origin.experiment, origin.values.tobytes(), origin.effects


def _no_values(space: Space, values: FloatArray) -> Outcome:
    """The outcome of a point at which a parameter has no value."""
    named = [p.name for p in space.problem.parameters if not p.auxiliary]
    first = int(np.flatnonzero(~np.isfinite(values))[0])
    return Outcome(
        -1,
        Status.NOT_FINITE,
        message=f"parameter {named[first]!r} is {values[first]}, so nothing was simulated",
    )
