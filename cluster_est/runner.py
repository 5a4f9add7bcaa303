"""The only loop: it feeds many searches from one queue and joins what comes back.

Searches never wait for each other. Outcomes arrive in any order and are joined in the order of the
experiments, so a search sees the same numbers whatever the workers did.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.errors import BudgetError
from cluster_est.executors.base import Executor
from cluster_est.methods.base import Ending, Evaluation, Method, Points, Progress, Search, Solution
from cluster_est.space import Space
from workers.messages import Effect, FloatArray, Outcome, Task, Want

MEMORY_BYTES = 64 * 2**20
"""Residuals that are remembered to answer a repeated question without simulating."""


@dataclass(frozen=True)
class SearchRequest:
    """One search: a method let loose on a space.

    `name` tells searches apart in the log; `seed` starts the method's random generator.
    """

    name: str
    method: Method
    space: Space
    seed: int = 0


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


@dataclass
class _Active:
    """A search in progress and the request that it waits for."""

    request: SearchRequest
    steps: Search
    points: Points | None = None
    first: int = 0
    missing: int = 0
    outcomes: list[list[Outcome | None]] = field(default_factory=list)
    asked: int = 0
    best: Evaluation | None = None
    best_x: FloatArray | None = None
    progress: Progress = field(default_factory=lambda: Progress(0, np.nan))
    solution: Solution | None = None


_Slot = tuple[_Active, int, int]
_Question = tuple[int, bytes, tuple[Effect, ...]]
Record = Callable[[Origin, Outcome], None]
Show = Callable[[Snapshot], None]


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
        *,
        whole: bool = False,
    ) -> None:
        self._executor = executor
        self._budget = budget or Budget()
        self._record = record or (lambda origin, outcome: None)
        self._show = show or (lambda snapshot: None)
        self._whole = whole
        self._begin = time.monotonic()
        self._next_task = 0
        self._origins: dict[int, Origin] = {}
        self._waiting: dict[_Question, list[_Slot]] = {}
        self._known: dict[_Question, Outcome] = {}
        self._known_bytes = 0
        self.evaluations = 0
        self.simulations = 0
        self.failures = 0

    def run(self, requests: Sequence[SearchRequest]) -> list[Solution]:
        """Run searches to their ends, all at the same time.

        A keyboard interrupt ends all of them with their best points so far, unless `whole`.

        Raises
        ------
        BudgetError
            If `whole` and the budget is used up.
        """
        self._refuse_if_exhausted([])
        searches = [self._open(request) for request in requests]
        try:
            for search in searches:
                self._advance(search, None)
            while any(search.solution is None for search in searches):
                for outcome in self._executor.completed():
                    self._receive(outcome)
                self._display(searches)
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
        return [search.solution for search in searches if search.solution is not None]

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
                    self._note(self._origins.pop(outcome.task), outcome)
                    answers[outcome.task] = outcome
                else:  # left over from a search that was ended from outside
                    self._receive(outcome)
        return [answers[task.id] for task in tasks]

    def _open(self, request: SearchRequest) -> _Active:
        generator = np.random.default_rng(request.seed)
        return _Active(request, request.method.search(request.space, generator))

    def _advance(self, search: _Active, answers: list[Evaluation] | None) -> None:
        """Send a search its answers and queue what it asks for next."""
        while True:
            try:
                points = next(search.steps) if answers is None else search.steps.send(answers)
            except StopIteration as end:
                search.solution = end.value
                return
            if search.asked and self._exhausted():
                self._finish(search, Ending.BUDGET)
                return
            self._ask(search, points)
            if search.missing:
                return
            answers = self._join(search)

    def _ask(self, search: _Active, points: Points) -> None:
        """Queue the tasks of a request, experiment by experiment; skip what is known already."""
        space = search.request.space
        search.points, search.first = points, search.asked
        search.progress = points.progress or search.progress
        search.asked += len(points.x)
        self.evaluations += len(points.x)
        search.outcomes = [[None] * len(space.experiments) for _ in points.x]
        search.missing = len(points.x) * len(space.experiments)
        physical = np.array([space.physical(x) for x in points.x])
        tasks: list[Task] = []
        for e, experiment in enumerate(space.experiments):
            for p in range(len(points.x)):
                task = self._question(search, p, e, experiment, physical[p, e])
                tasks += [task] if task is not None else []
        self._executor.submit(tasks)

    def _question(
        self, search: _Active, p: int, e: int, experiment: int, values: FloatArray
    ) -> Task | None:
        effects = search.request.space.problem.effects
        question = (experiment, values.tobytes(), effects)
        if question in self._known:
            self._place((search, p, e), self._known[question])
            return None
        if question in self._waiting:
            self._waiting[question].append((search, p, e))
            return None
        self._waiting[question] = [(search, p, e)]
        purpose = search.points.purpose if search.points else ""
        evaluation = search.first + p
        origin = Origin(search.request.name, evaluation, purpose, experiment, values, effects)
        return self._task(origin, "residuals")

    def _task(self, origin: Origin, want: Want) -> Task:
        task = Task(self._next_task, origin.experiment, origin.values, want, origin.effects)
        self._next_task += 1
        self._origins[task.id] = origin
        return task

    def _receive(self, outcome: Outcome) -> None:
        origin = self._origins.pop(outcome.task, None)
        if origin is None:
            return
        self._note(origin, outcome)
        question = (origin.experiment, origin.values.tobytes(), origin.effects)
        self._remember(question, outcome)
        for slot in self._waiting.pop(question, []):
            self._place(slot, outcome)
            search = slot[0]
            if search.missing == 0 and search.solution is None:
                self._advance(search, self._join(search))

    def _place(self, slot: _Slot, outcome: Outcome) -> None:
        search, p, e = slot
        search.outcomes[p][e] = outcome
        search.missing -= 1

    def _remember(self, question: _Question, outcome: Outcome) -> None:
        size = 0 if outcome.residuals is None else outcome.residuals.nbytes
        if self._known_bytes + size > MEMORY_BYTES:
            self._known.clear()
            self._known_bytes = 0
        self._known[question] = outcome
        self._known_bytes += size

    def _join(self, search: _Active) -> list[Evaluation]:
        """The evaluations of a complete request, each with its experiments in order."""
        cost = search.request.space.problem.cost
        evaluations = []
        for p, row in enumerate(search.outcomes):
            joined = Evaluation(tuple(o for o in row if o is not None), np.nan)
            if joined.ok:
                joined = Evaluation(joined.outcomes, cost.value(joined.residuals))
                if search.best is None or joined.cost < search.best.cost:
                    search.best = joined
                    search.best_x = search.points.x[p] if search.points else None
            evaluations.append(joined)
        return evaluations

    def _note(self, origin: Origin, outcome: Outcome) -> None:
        self.simulations += 1
        self.failures += not outcome.ok
        self._record(origin, outcome)

    def _finish(self, search: _Active, ending: Ending) -> None:
        """End a search from outside, with the best point that it has seen."""
        start = search.request.space.start
        x = start if search.best_x is None else search.best_x
        cost = np.nan if search.best is None else search.best.cost
        search.solution = Solution(x, cost, ending, iterations=search.progress.iteration)
        search.missing = -1

    def _exhausted(self) -> bool:
        most, longest = self._budget.evaluations, self._budget.seconds
        used = time.monotonic() - self._begin
        return (most is not None and self.evaluations >= most) or (
            longest is not None and used >= longest
        )

    def _refuse_if_exhausted(self, searches: Sequence[_Active]) -> None:
        cut = [s for s in searches if s.solution and s.solution.ending is Ending.BUDGET]
        if self._whole and self._exhausted() and (cut or not searches):
            raise BudgetError(
                f"budget: was used up after {self.evaluations} evaluations in "
                f"{time.monotonic() - self._begin:.0f} s; raise budget.evaluations or "
                "budget.seconds, or leave them out"
            )

    def _display(self, searches: Sequence[_Active]) -> None:
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
