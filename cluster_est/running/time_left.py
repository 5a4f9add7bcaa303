"""The time that searches still take, from the work that is left and the speed of what is done.

Three things tell how much work is left: a budget of evaluations or seconds, a limit of iterations
or points that will be reached, and the searches of many that have ended, whose lengths those of the
others resemble. Nothing tells it of a single search that converges: its step, mesh or cost falls at
a rate that changes all the time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.errors import BudgetError
from cluster_est.methods.method import GivenPoints
from cluster_est.running.resources import Budget
from cluster_est.running.search_state import SearchState
from workers.messages import FloatArray

TELLING_ITERATIONS = 25
"""A search that may take more iterations mostly takes far fewer: its limit tells no time."""
LEAST_SHARE = 0.05
"""Share of the work from whose time that of the rest is known."""
LEAST_ENDED = 3
"""Searches that have ended, from whose lengths those of the others are known."""


@dataclass(frozen=True)
class WorkDone:
    """The work of a runner so far.

    Attributes
    ----------
    seconds
        Since it began.
    simulations, under_way, busy
        That have ended, that are asked for, and those of them that workers are at.
    evaluations, requests
        Points that were asked for, and in how many requests.
    """

    seconds: float
    simulations: int
    under_way: int
    busy: int
    evaluations: int
    requests: int

    @property
    def done(self) -> float:
        """Simulations that have ended; of those that workers are at, on average, a half."""
        return self.simulations + 0.5 * self.busy

    def seconds_for(self, evaluations: float) -> float:
        """Return the seconds of what is asked for and of further evaluations; NaN if not known."""
        if not self.simulations or not self.evaluations:
            return np.nan
        of_each = (self.simulations + self.under_way) / self.evaluations
        left = self.under_way - 0.5 * self.busy + of_each * evaluations
        return left * self.seconds / self.done

    @property
    def per_request(self) -> float:
        """Points of a request, on average."""
        return self.evaluations / max(self.requests, 1)


def left_of_budget(work: WorkDone, evaluations: int | None) -> float:
    """Return the seconds until so many further points are evaluated; NaN if not known.

    The last request may exceed a budget: on average by half of a request.
    """
    if evaluations is None:
        return np.inf
    return work.seconds_for(evaluations + 0.5 * work.per_request if evaluations else 0.0)


def share_done(searches: Sequence[SearchState]) -> float:
    """Return the share of the work of searches that is done at least; NaN if nobody knows.

    Of a search with few iterations that is the share of these, of given points that of those that
    are evaluated.
    """
    return float(np.mean([_share(search) for search in searches])) if searches else np.nan


def _share(search: SearchState) -> float:
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
    return float(min(1.0, (search.progress.iteration + _of_iteration(search, answered)) / most))


def _of_iteration(search: SearchState, answered: float) -> float:
    """Return the share of an iteration that is done, where it is a single request."""
    return answered if search.purpose == "generation" else 0.0


def time_left(share: float, seconds: float) -> float:
    """Return the seconds that the rest of the work takes at most; NaN if nobody knows."""
    if np.isnan(share) or share < LEAST_SHARE:
        return np.nan
    return seconds * (1.0 - share) / share


def evaluations_left(searches: Sequence[SearchState]) -> float:
    """Return how many points searches that converge will still ask for; NaN if nobody knows.

    From the lengths of those that have ended, if there are some, and how far the others are.
    """
    ended = np.array([s.asked for s in searches if s.solution is not None], np.float64)
    begun = np.array([s.asked for s in searches if s.solution is None], np.float64)
    if len(ended) < max(LEAST_ENDED, LEAST_SHARE * len(searches)):
        return np.nan
    lengths, weights = _lengths(ended, begun[begun > 0.0])
    return float(sum(_residual(lengths, weights, asked) for asked in begun))


def _lengths(ended: FloatArray, begun: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lengths of searches, and the probability of each.

    The estimate of E. L. Kaplan, P. Meier, J. Am. Stat. Assoc. 53 (1958) 457-481,
    doi:10.1080/01621459.1958.10501452: those that are under way are longer than they are now. If
    the longest one is among them, it is taken to end at the next point.
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
    """Return the expected number of points that a search still asks for after so many."""
    longer = lengths > asked
    total = float(np.add.reduce(weights[longer]))
    if total <= 0.0:
        return 0.0
    return float(np.add.reduce(weights[longer] * (lengths[longer] - asked))) / total


class BudgetWatch:
    """Counts evaluations and seconds from now on.

    Parameters
    ----------
    budget
        When to stop.
    clock
        Gives seconds.

    Attributes
    ----------
    evaluations, requests
        Points asked for so far, and in how many requests; the runner adds to them.
    used_up
        True once a search has ended because no room was left for what it needed next.
    """

    def __init__(self, budget: Budget, clock: Callable[[], float] = time.monotonic) -> None:
        self._budget, self._clock = budget, clock
        self._begin = clock()
        self.evaluations = 0
        self.requests = 0
        self.used_up = False

    @property
    def seconds(self) -> float:
        """Used so far."""
        return self._clock() - self._begin

    @property
    def exhausted(self) -> bool:
        """True where nothing new may be asked for."""
        longest = self._budget.seconds
        late = longest is not None and self.seconds >= longest
        return self.used_up or self.evaluations_left == 0 or late

    def has_room(self, points: int) -> bool:
        """Return whether so many points can be evaluated before it ends by their number."""
        return points <= self.evaluations_left

    @property
    def evaluations_left(self) -> float:
        """Points that may be asked for still; infinite where their number ends nothing."""
        most = self._budget.evaluations
        return np.inf if most is None else max(most - self.evaluations, 0)

    @property
    def counts_evaluations(self) -> bool:
        """True where it may end by the number of evaluations."""
        return self._budget.evaluations is not None

    def left(self, work: WorkDone) -> float:
        """Return the seconds until it is used up; infinite without one, NaN if not known.

        `work` is what was done since the runner began, or since its last step did.
        """
        longest = self._budget.seconds
        points = int(self.evaluations_left) if self.counts_evaluations else None
        time_limit = np.inf if longest is None else max(longest - self.seconds, 0.0)
        return float(np.fmin(time_limit, left_of_budget(work, points)))

    def error(self) -> BudgetError:
        """Return the error that says so."""
        return BudgetError(
            f"budget: was used up after {self.evaluations} evaluations in {self.seconds:.0f} s; "
            "raise budget.evaluations or budget.seconds, or leave them out"
        )
