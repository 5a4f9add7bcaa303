"""The state of a runner as a display shows it: what is done, how much of it, and the time left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from cluster_est.executors.base import Executor
from cluster_est.running.budget_watch import BudgetWatch
from cluster_est.running.pending_tasks import PendingTasks
from cluster_est.running.records import RunSnapshot, Show
from cluster_est.running.search_state import SearchState
from cluster_est.running.time_left import WorkDone, evaluations_left, share_done, time_left


class RunDisplay:
    """Tells a display how far a runner is.

    Parameters
    ----------
    show
        Called with each snapshot; None where nobody looks.
    executor, budget, pending
        Of the runner.
    clock
        Gives seconds; for tests.

    Attributes
    ----------
    phase
        What the recipe is about, in words that begin a line; "" where it is no recipe of phases.
    """

    def __init__(
        self,
        show: Show | None,
        executor: Executor,
        budget: BudgetWatch,
        pending: PendingTasks,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._show, self._executor, self._budget = show, executor, budget
        self._pending, self._clock = pending, clock
        self._begun = clock()
        self._before = (0, 0, 0)
        self.phase = ""

    def begin(self) -> None:
        """Note that searches begin together."""
        self._begun = self._clock()
        budget = self._budget
        self._before = self._pending.simulations, budget.evaluations, budget.requests

    def show(self, searches: Sequence[SearchState]) -> None:
        """Show how far they are."""
        if self._show is None:
            return
        running = [s for s in searches if s.solution is None] or list(searches)
        busy = self._executor.busy
        left, at_most = self._left(searches)
        self._show(
            RunSnapshot(
                search=running[0].request.name,
                progress=running[0].progress,
                evaluations=self._budget.evaluations,
                simulations=self._pending.simulations,
                failures=self._pending.failures,
                busy=busy,
                workers=self._executor.workers,
                seconds=self._budget.seconds,
                phase=self.phase,
                ended=sum(s.solution is not None for s in searches),
                searches=len(searches),
                left=left,
                at_most=at_most,
                waiting=max(0, self._pending.under_way - busy),
                pace=self._pace(searches),
            )
        )

    def _pace(self, searches: Sequence[SearchState]) -> float:
        """Return the seconds of an iteration so far; NaN where there are none, or many searches."""
        iterations = searches[0].progress.iteration if len(searches) == 1 else 0
        return (self._clock() - self._begun) / iterations if iterations else math.nan

    def _left(self, searches: Sequence[SearchState]) -> tuple[float, bool]:
        """Return the seconds that searches take from now on, and whether they are a limit.

        NaN if nobody knows.
        """
        seconds = self._clock() - self._begun
        simulations, evaluations, requests = self._before
        work = WorkDone(
            seconds,
            self._pending.simulations - simulations,
            self._pending.under_way,
            self._executor.busy,
            self._budget.evaluations - evaluations,
            self._budget.requests - requests,
        )
        limits = [self._budget.left(work), time_left(share_done(searches), seconds)]
        limit = min((each for each in limits if math.isfinite(each)), default=math.nan)
        about = work.seconds_for(evaluations_left(searches))
        return (limit, True) if math.isnan(about) or limit < about else (about, False)
