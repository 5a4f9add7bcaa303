"""The runner: the main loop that runs many searches with one queue of tasks.

Searches wait for each other only if they share a budget of evaluations. Outcomes arrive in any
order and are sorted by experiment. So the evaluations of a search do not depend on the workers.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.executors.executor import Executor
from cluster_est.methods.method import (
    BudgetTooShortError,
    Ending,
    Evaluation,
    Points,
    Progress,
    Solution,
)
from cluster_est.running.interrupts import DeferredInterrupts, later
from cluster_est.running.resources import Budget, Note, Record, SearchIteration, Show
from cluster_est.running.search_state import PendingTasks, SearchRequest, SearchState, suited
from cluster_est.running.time_left import BudgetWatch, RunDisplay
from workers.messages import Effect, FloatArray, Outcome, ResetPolicy, Status, Task, Want

SUBMITTED_AT_ONCE = 1000
HURRY_SECONDS = 3.0
Enough = Callable[[Sequence[Solution]], bool]


class Runner:
    """A runner of searches on an executor.

    Parameters
    ----------
    executor
        The executor of the tasks, with the experiments of the spaces' problem.
    budget
        Budget of all searches together.
    record
        Called once for each simulation, in the order in which they end.
    show
        Called after each group of outcomes.
    note
        Called for each new line of a search's iteration table, and once more at its end.
    whole
        True for a recipe of many steps that needs complete searches. `run` then raises
        KeyboardInterrupt after an interrupt, and BudgetError if the budget is used up.
    clock
        Function that returns seconds; for studies with virtual time.
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
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._executor = executor
        self._budget = BudgetWatch(budget or Budget(), clock)
        self._pending = PendingTasks(executor, record or (lambda *_: None))
        self.display = RunDisplay(show, executor, self._budget, self._pending, clock)
        """The display of the progress; a recipe sets its phase."""
        self._note = note or (lambda *_: None)
        self._whole = whole
        self._in_step = False
        self.interrupted = False
        """Whether the runner was interrupted.

        Then no search goes on, and `simulate` has only a few seconds."""

    @property
    def evaluations(self) -> int:
        """Number of points that all searches have requested."""
        return self._budget.evaluations

    @property
    def evaluations_left(self) -> float:
        """Number of points left in the budget; infinite without a limit."""
        return self._budget.evaluations_left

    @property
    def simulations(self) -> int:
        """Number of simulations that were run or found in a log."""
        return self._pending.simulations

    @property
    def failures(self) -> int:
        """Number of failed simulations that were run or found in a log."""
        return self._pending.failures

    @contextlib.contextmanager
    def uncounted(self) -> Iterator[None]:
        """Neither count nor record simulations within this context.

        Use it for intermediate displays that do not affect the run.
        """
        budget, pending = self._budget, self._pending
        before = budget.evaluations, budget.requests
        try:
            with pending.uncounted():
                yield
        finally:
            budget.evaluations, budget.requests = before

    def forget(self) -> None:
        """Clear the cache of outcomes; call it after the last search."""
        self._pending.forget()

    def free_instances(self, workers: int) -> ResetPolicy:
        """Free the instances of the first workers until their next task.

        Returns the reset policy, for code that creates instances in their place.
        """
        self._executor.free_instances(workers)
        return self._executor.reset

    def run(
        self,
        requests: Sequence[SearchRequest],
        at_once: int | None = None,
        enough: Enough | None = None,
    ) -> list[Solution]:
        """Run searches to their ends, all at the same time.

        A keyboard interrupt ends all searches with their best points so far, unless `whole`.

        Parameters
        ----------
        requests
            The searches.
        at_once
            Largest number of simultaneous searches; the others begin in their order.
        enough
            Called with the solutions of the first searches each time one more of them, in their
            order, has ended. If it returns True, the other searches are abandoned. So the result
            does not depend on the speed of the searches.

        Returns
        -------
        list of Solution
            Solutions in the order of the requests; fewer if `enough` returned True.

        Raises
        ------
        BudgetError
            If `whole` and the budget is used up.
        """
        self._refuse_if_exhausted([])
        searches = [self._open(request) for request in requests]
        for search in searches:
            search.counts = enough is None
        # With a budget of evaluations, searches advance in step, so that the order of the requests
        # decides which searches the budget ends. This is unnecessary if `whole`.
        counted = self._budget.evaluations_left < np.inf
        self._in_step = counted and len(searches) > 1 and not self._whole
        try:
            if not self.interrupted:
                with DeferredInterrupts() as interrupts:
                    enough = enough or (lambda _: False)
                    searches = self._run(searches, at_once, enough, interrupts)
        except KeyboardInterrupt:
            self._interrupt()
            if self._whole:
                raise
        finally:
            for search in searches:
                search.steps.close()
        for search in searches:
            if search.solution is None:
                self._finish(search, Ending.INTERRUPTED)
            self._count(search)
        self._refuse_if_exhausted(searches)
        solutions = _solutions(searches)
        self._budget.used_up |= any(found.ending is Ending.BUDGET for found in solutions)
        return solutions

    def _interrupt(self) -> None:
        """Mark the runner as interrupted, and cancel all tasks that have not begun."""
        self.interrupted = True
        self._pending.drop_all()

    def _run(
        self,
        searches: list[SearchState],
        at_once: int | None,
        enough: Enough,
        interrupts: DeferredInterrupts,
    ) -> list[SearchState]:
        """Run until all searches have ended or the first are enough; return the used searches."""
        self.display.begin()
        waiting = searches[::-1]
        counted = 0
        while counted < len(searches):
            self._count(searches[counted])
            self._begin_searches(waiting, searches, at_once)
            if searches[counted].solution is None:
                with interrupts.waiting():
                    outcomes = self._executor.completed()
                for outcome in outcomes:
                    self._receive(outcome)
                begun = searches[: len(searches) - len(waiting)]
                under_way = [search for search in begun if search.solution is None]
                if self._in_step and all(search.ready for search in under_way):
                    for search in under_way:
                        self._advance(search, search.take_answers())
                self.display.show(searches)
                continue
            counted += 1
            if enough(_solutions(searches[:counted])):
                for unwanted in searches[counted:]:
                    self._drop(unwanted, tuple(unwanted.pending))
                    unwanted.steps.close()
                return searches[:counted]
        return searches

    def _begin_searches(
        self, waiting: list[SearchState], searches: Sequence[SearchState], at_once: int | None
    ) -> None:
        """Begin the next searches in their order, up to `at_once` simultaneous searches."""
        while waiting:
            begun = len(searches) - len(waiting)
            under_way = sum(s.solution is None for s in searches[:begun])
            if at_once is not None and under_way >= at_once:
                return
            search = waiting.pop()
            if begun and self._budget.exhausted:
                self._finish(search, Ending.BUDGET)
            else:
                self._advance(search, None)

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
            Indices of the problem's experiments.
        want, name
            The wanted result, and the name in the log.
        effects
            Effects that are added to the model.
        """
        tasks = []
        for row, experiment in zip(values, experiments, strict=True):
            tasks.append(self._pending.task(name, want, experiment, row, effects))
        own = {task.id for task in tasks}
        answers: dict[int, Outcome] = {}
        self._executor.submit(tasks)
        try:
            # after an interrupt there are only a few seconds for simulations
            hurry: contextlib.AbstractContextManager[None] = (
                later(HURRY_SECONDS) if self.interrupted else contextlib.nullcontext()
            )
            with DeferredInterrupts() as interrupts, hurry:
                while len(answers) < len(tasks):
                    with interrupts.waiting():
                        outcomes = self._executor.completed()
                    for outcome in outcomes:
                        if outcome.task in own:
                            answers[outcome.task] = self._pending.note(outcome)
                        else:  # from a search that was ended from outside
                            self._receive(outcome)
        except KeyboardInterrupt:
            self._interrupt()
            if self._whole:
                raise
        said = "the run was interrupted before this simulation"
        return [
            answers.get(task.id, Outcome(task.id, Status.NOT_RUN, message=said)) for task in tasks
        ]

    def _open(self, request: SearchRequest) -> SearchState:
        generator = np.random.default_rng(request.seed)
        request = replace(request, space=suited(request.space, request.method))
        return SearchState(request, request.method.search(request.space, generator))

    def _advance(self, search: SearchState, answers: list[Evaluation] | None) -> None:
        """Send evaluations to a search and queue its next requests."""
        while True:
            try:
                points = next(search.steps) if answers is None else search.steps.send(answers)
                # the budget is too small for the follow-up points
                while (
                    points.follow_up
                    and not (self._whole or self._budget.exhausted)
                    and len(points.x) + points.follow_up > self._budget.evaluations_left
                ):
                    points = search.steps.throw(BudgetTooShortError())
            except StopIteration as end:
                search.solution = end.value
                self._end(search)
                return
            if search.asked and self._budget.exhausted:
                self._finish(search, Ending.BUDGET)
                return
            self._ask(search, points)
            if not search.ready:
                return
            answers = search.take_answers()

    def _ask(self, search: SearchState, points: Points) -> None:
        """Queue the tasks of a request."""
        if points.progress is not None and points.progress != search.progress:
            search.progress = points.progress
            self._note_line(search, points.progress)
        self._drop(search, points.drop)
        self._budget.evaluations += len(points.x)
        self._budget.requests += len(points.x) > 0
        tasks: list[Task] = []
        for task in self._pending.request(search, points):
            tasks.append(task)
            if len(tasks) == SUBMITTED_AT_ONCE:  # workers begin while the others are prepared
                self._executor.submit(tasks)
                tasks = []
        self._executor.submit(tasks)

    def _receive(self, outcome: Outcome) -> None:
        """Store an outcome in the searches that wait for it, and advance ready searches."""
        for search in self._pending.receive(outcome):
            if search.ready and search.solution is None and not self._in_step:
                self._advance(search, search.take_answers())

    def _drop(self, search: SearchState, indices: tuple[int, ...]) -> None:
        """Drop pending points of a search, and cancel their simulations if possible."""
        for index in indices:
            search.pending.pop(index, None)
        if indices:
            self._pending.drop_unwanted()

    def _finish(self, search: SearchState, ending: Ending) -> None:
        """End a search from outside, with its best point so far."""
        search.cut_short(ending)
        self._end(search)

    def _end(self, search: SearchState) -> None:
        """Add the last line to the iteration table of a search."""
        last = search.last_line()
        if last is not None:
            self._note_line(search, last)

    def _note_line(self, search: SearchState, line: Progress) -> None:
        """Add a line to a search's table, at once if the search certainly counts.

        Lines of a search that may be abandoned are held back, because they depend on timing.
        """
        best = search.best_point()
        search.lines.append(SearchIteration(search.request.name, line, search.asked, best))
        if search.counts:
            self._count(search)

    def _count(self, search: SearchState) -> None:
        """Mark a search as counted, and note its lines so far."""
        search.counts, lines, search.lines = True, search.lines, []
        for line in lines:
            self._note(line)

    def _refuse_if_exhausted(self, searches: Sequence[SearchState]) -> None:
        cut = [s for s in searches if s.solution and s.solution.ending is Ending.BUDGET]
        if self._whole and self._budget.exhausted and (cut or not searches):
            raise self._budget.error()


def _solutions(searches: Sequence[SearchState]) -> list[Solution]:
    return [search.solution for search in searches if search.solution is not None]
