"""The budget of a run, and how much of it is used."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from cluster_est.errors import BudgetError
from cluster_est.running.records import Budget
from cluster_est.running.time_left import WorkDone, left_of_budget


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
