"""The budget of a run, and how much of it is used."""

from __future__ import annotations

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
    def exhausted(self) -> bool:
        """True where nothing new may be asked for."""
        most, longest = self._budget.evaluations, self._budget.seconds
        return (most is not None and self.evaluations >= most) or (
            longest is not None and self.seconds >= longest
        )

    @property
    def counts_evaluations(self) -> bool:
        """True where it may end by the number of evaluations."""
        return self._budget.evaluations is not None

    def error(self) -> BudgetError:
        """Return the error that says so."""
        return BudgetError(
            f"budget: was used up after {self.evaluations} evaluations in {self.seconds:.0f} s; "
            "raise budget.evaluations or budget.seconds, or leave them out"
        )
