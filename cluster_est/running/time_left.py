"""Estimates of the remaining time of searches, from the remaining work and the speed so far.

The remaining work follows from one of three sources: a budget of evaluations or seconds; a limit of
iterations or points; or the lengths of other searches that have ended. It is unknown for a single
converging search, because the rate of decrease of its step, mesh or cost varies.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.errors import BudgetError
from cluster_est.executors.executor import Executor
from cluster_est.methods.method import GivenPoints, Progress
from cluster_est.running.resources import Budget, RunSnapshot, Show
from cluster_est.running.search_state import PendingTasks, SearchState
from workers.messages import FloatArray

TELLING_ITERATIONS = 25
"""Largest limit of iterations that is used as an estimate.

With a higher limit, most searches end long before the limit."""
LEAST_SHARE_OF_WORK = 0.05
"""Least share of completed work for an estimate of the remaining time."""
LEAST_ENDED = 3
"""Least number of ended searches for an estimate of the lengths of the others."""


def _share_done(search: SearchState) -> float:
    """Return a lower limit of the completed share of a search; NaN if unknown.

    It is the share of iterations if their limit is small, or the share of evaluated given points.
    """
    if search.solution is not None:
        return 1.0
    method, waits = search.request.method, len(search.pending)
    if isinstance(method, GivenPoints):
        return 1.0 - waits / search.asked if search.asked else 0.0
    limits = [getattr(method, name, None) for name in ("max_iterations", "max_generations")]
    (most,) = [limit for limit in limits if isinstance(limit, int)] or [0]
    if not 0 < most <= TELLING_ITERATIONS:
        return np.nan
    answered = 1.0 - waits / search.requested if search.requested else 0.0
    # an iteration has a completed share only if it is a single request
    of_iteration = answered if search.purpose == "generation" else 0.0
    return float(min(1.0, (search.progress.iteration + of_iteration) / most))


def _evaluations_left(searches: Sequence[SearchState]) -> float:
    """Return the expected number of further points of converging searches; NaN if unknown.

    It follows from the lengths of the ended searches and the numbers of points of the others.
    """
    ended = np.array([s.asked for s in searches if s.solution is not None], np.float64)
    begun = np.array([s.asked for s in searches if s.solution is None], np.float64)
    if len(ended) < max(LEAST_ENDED, LEAST_SHARE_OF_WORK * len(searches)):
        return np.nan
    lengths, weights = _lengths(ended, begun[begun > 0.0])
    return float(sum(_residual(lengths, weights, asked) for asked in begun))


def _lengths(ended: FloatArray, begun: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lengths of searches, and the probability of each length.

    The Kaplan-Meier estimate with running searches as censored observations: E. L. Kaplan,
    P. Meier, J. Am. Stat. Assoc. 53 (1958) 457-481, doi:10.1080/01621459.1958.10501452. If the
    longest search is still running, it counts as ended.
    """
    times = np.concatenate([ended, begun])
    is_end = np.arange(len(times)) < len(ended)
    order = np.lexsort((~is_end, times))
    times, is_end = times[order], is_end[order]
    is_end[-1] = True
    at_risk = np.arange(len(times), 0, -1)
    survival = np.cumprod(np.where(is_end, 1.0 - 1.0 / at_risk, 1.0))
    return times, -np.diff(survival, prepend=1.0)


def _residual(lengths: FloatArray, weights: FloatArray, asked: float) -> float:
    """Return the expected number of further points of a search after `asked` points."""
    longer = lengths > asked
    total = float(np.add.reduce(weights[longer]))
    if total <= 0.0:
        return 0.0
    return float(np.add.reduce(weights[longer] * (lengths[longer] - asked))) / total


class BudgetWatch:
    """A counter of evaluations and seconds, which begins when it is created.

    Parameters
    ----------
    budget
        Limits of evaluations and seconds.
    clock
        Function that returns seconds.

    Attributes
    ----------
    evaluations, requests
        Number of points and of requests so far; the runner adds to them.
    used_up
        True after a search has ended because the budget was too small for its next request.
    """

    def __init__(self, budget: Budget, clock: Callable[[], float] = time.monotonic) -> None:
        self._budget, self._clock = budget, clock
        self._begin = clock()
        self.evaluations = 0
        self.requests = 0
        self.used_up = False

    @property
    def seconds(self) -> float:
        """Seconds used so far."""
        return self._clock() - self._begin

    @property
    def exhausted(self) -> bool:
        """True if no further points may be requested."""
        return self.used_up or self.evaluations_left == 0 or self.seconds_left == 0.0

    @property
    def evaluations_left(self) -> float:
        """Number of points that may still be requested; infinite without a limit."""
        most = self._budget.evaluations
        return np.inf if most is None else max(most - self.evaluations, 0)

    @property
    def seconds_left(self) -> float:
        """Seconds until the budget is used up; infinite without a limit."""
        longest = self._budget.seconds
        return np.inf if longest is None else max(longest - self.seconds, 0.0)

    def error(self) -> BudgetError:
        """Return the error for a budget that is used up."""
        return BudgetError(
            f"budget: was used up after {self.evaluations} evaluations in {self.seconds:.0f} s; "
            "raise budget.evaluations or budget.seconds, or leave them out"
        )


class RunDisplay:
    """The display of a runner's progress.

    Parameters
    ----------
    show
        Called with each snapshot; None without a display.
    executor, budget, pending
        Executor, budget and tasks of the runner.
    clock
        Function that returns seconds; for tests.

    Attributes
    ----------
    phase
        Text of the current phase at the beginning of a line; "" without phases.
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
        self._last: RunSnapshot | None = None
        self.phase = ""

    def begin(self) -> None:
        """Record the start of a group of searches."""
        self._begun = self._clock()
        budget = self._budget
        self._before = self._pending.simulations, budget.evaluations, budget.requests

    def show(self, searches: Sequence[SearchState]) -> None:
        """Show the progress of a group of searches."""
        if self._show is None:
            return
        running = [s for s in searches if s.solution is None] or list(searches)
        busy, seconds = self._executor.busy, self._clock() - self._begun
        left, at_most = self._left(searches, seconds)
        iterations = searches[0].progress.iteration if len(searches) == 1 else 0
        self._tell(
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
                pace=seconds / iterations if iterations else math.nan,
            )
        )

    def step(self, name: str, done: int, of: int) -> None:
        """Show the progress of a step without simulations; `name` is like that of a search."""
        seconds = self._budget.seconds
        before = self._last or RunSnapshot(
            name, Progress(0, math.nan), self._budget.evaluations, 0, 0, 0, 0, seconds
        )
        self._tell(
            replace(
                before,
                search=name,
                progress=Progress(0, math.nan),
                seconds=seconds,
                phase=self.phase,
                busy=0,
                waiting=0,
                ended=done,
                searches=of,
                left=math.nan,
                pace=math.nan,
            )
        )

    def _tell(self, snapshot: RunSnapshot) -> None:
        self._last = snapshot
        if self._show is not None:
            self._show(snapshot)

    def _left(self, searches: Sequence[SearchState], seconds: float) -> tuple[float, bool]:
        """Return the remaining seconds of searches (NaN if unknown), and whether it is a limit."""
        budget = self._budget
        share = float(np.mean([_share_done(search) for search in searches]))
        points = budget.evaluations_left
        if 0.0 < points < math.inf:  # the last request exceeds it on average by half a request
            evaluations = budget.evaluations - self._before[1]
            requests = budget.requests - self._before[2]
            points += 0.5 * evaluations / max(requests, 1)
        limits = [
            budget.seconds_left,
            self._seconds_for(points, seconds),
            seconds * (1.0 - share) / share if share >= LEAST_SHARE_OF_WORK else math.nan,
        ]
        limit = min((each for each in limits if math.isfinite(each)), default=math.nan)
        about = self._seconds_for(_evaluations_left(searches), seconds)
        return (limit, True) if math.isnan(about) or limit < about else (about, False)

    def _seconds_for(self, points: float, seconds: float) -> float:
        """Return the seconds for all pending simulations and further points; NaN if unknown.

        A running simulation is on average half done.
        """
        simulations = self._pending.simulations - self._before[0]
        evaluations = self._budget.evaluations - self._before[1]
        if not simulations or not evaluations:
            return math.nan
        under_way, half = self._pending.under_way, 0.5 * self._executor.busy
        of_each = (simulations + under_way) / evaluations
        return (under_way - half + of_each * points) * seconds / (simulations + half)
