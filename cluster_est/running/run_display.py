"""The state of a runner as a display shows it: what is done, how much of it, and the time left."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from cluster_est.executors.base import Executor
from cluster_est.methods.given_points import GivenPoints
from cluster_est.running.budget_watch import BudgetWatch
from cluster_est.running.pending_tasks import PendingTasks
from cluster_est.running.records import RunSnapshot, Show
from cluster_est.running.search_state import SearchState

TELLING_ITERATIONS = 25
"""A search that may take more iterations mostly takes far fewer: its limit tells no time."""
LEAST_SHARE = 0.05
"""Share of the work from whose time that of the rest is known."""


class RunDisplay:
    """Tells a display how far a runner is.

    Parameters
    ----------
    show
        Called with each snapshot.
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
        show: Show,
        executor: Executor,
        budget: BudgetWatch,
        pending: PendingTasks,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._show, self._executor, self._budget = show, executor, budget
        self._pending, self._clock = pending, clock
        self._begun = clock()
        self.phase = ""

    def begin(self) -> None:
        """Note that searches begin together."""
        self._begun = self._clock()

    def show(self, searches: Sequence[SearchState]) -> None:
        """Show how far they are."""
        running = [s for s in searches if s.solution is None] or list(searches)
        busy = self._executor.busy
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
                left=time_left(share_done(searches), self._clock() - self._begun),
                waiting=max(0, self._pending.under_way - busy),
            )
        )


def share_done(searches: Sequence[SearchState]) -> float:
    """Return the share of the work of searches that is done at least; NaN if nobody knows.

    Of a search with few iterations that is the share of these, of given points that of those that
    are evaluated.
    """
    return float(np.mean([_share(search) for search in searches])) if searches else np.nan


def _share(search: SearchState) -> float:
    if search.solution is not None:
        return 1.0
    if isinstance(search.request.method, GivenPoints):
        return 1.0 - len(search.pending) / search.asked if search.asked else 0.0
    most = getattr(search.request.method, "max_iterations", None)
    if not isinstance(most, int) or not 0 < most <= TELLING_ITERATIONS:
        return np.nan
    return min(1.0, search.progress.iteration / most)


def time_left(share: float, seconds: float) -> float:
    """Return the seconds that the rest of the work takes at most; NaN if nobody knows."""
    if np.isnan(share) or share < LEAST_SHARE:
        return np.nan
    return seconds * (1.0 - share) / share
