"""The budget of a run, and how much of it is used."""

from __future__ import annotations

import math
import time

from cluster_est.errors import BudgetError
from cluster_est.running.records import Budget


class BudgetWatch:
    """Counts evaluations and seconds from now on.

    Parameters
    ----------
    budget
        When to stop.

    Attributes
    ----------
    evaluations
        Asked for so far; the runner adds to it.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._begin = time.monotonic()
        self.evaluations = 0

    @property
    def seconds(self) -> float:
        """Used so far."""
        return time.monotonic() - self._begin

    @property
    def out_of_time(self) -> bool:
        """True where the seconds are used up."""
        return self._budget.seconds is not None and self.seconds >= self._budget.seconds

    @property
    def exhausted(self) -> bool:
        """True where nothing new may be asked for."""
        most = self._budget.evaluations
        return self.out_of_time or (most is not None and self.evaluations >= most)

    def shares(self, searches: int) -> list[float]:
        """Return the evaluations that each of some searches may use: equal parts of what is left.

        They are fixed before the searches begin, so that none gets more because it is quicker.
        What cannot be divided goes to the first ones.
        """
        if self._budget.evaluations is None:
            return [math.inf] * searches
        left = max(self._budget.evaluations - self.evaluations, 0)
        return [(left + searches - 1 - i) // searches for i in range(searches)]

    def error(self) -> BudgetError:
        """Return the error that says so."""
        return BudgetError(
            f"budget: was used up after {self.evaluations} evaluations in {self.seconds:.0f} s; "
            "raise budget.evaluations or budget.seconds, or leave them out"
        )
