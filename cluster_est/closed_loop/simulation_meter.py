"""A count of what a closed loop has simulated."""

from __future__ import annotations

from collections.abc import Sequence

from cluster_est.running.resources import Record, TaskOrigin
from workers.messages import Experiment, Outcome


class SimulationMeter:
    """Counts simulations in units of a whole experiment, and hands them on to a record.

    Parameters
    ----------
    experiments
        Those that are installed; what has been shortened counts for its part.
    record
        Called for each simulation; may be None.
    """

    def __init__(self, experiments: Sequence[Experiment], record: Record | None) -> None:
        longest = max(e.stop - e.start for e in experiments)
        self._parts = [(e.stop - e.start) / longest for e in experiments]
        self._record = record
        self.full = 0.0

    def __call__(self, origin: TaskOrigin, outcome: Outcome) -> None:
        self.full += self._parts[origin.task.experiment]
        if self._record is not None:
            self._record(origin, outcome)
