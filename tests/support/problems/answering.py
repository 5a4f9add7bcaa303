from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from cluster_est.executors import Executor
from workers.messages import Outcome, Status

NONE = np.zeros(0)


class AnsweringExecutor(Executor):
    """Answers all that is queued when it is asked for what is completed."""

    workers = 1

    def __init__(self) -> None:
        self._queue: list = []

    def submit(self, tasks):
        self._queue += tasks

    def completed(self):
        outcomes = [self._answer(task) for task in self._queue]
        self._queue = []
        return outcomes

    @abstractmethod
    def _answer(self, task) -> Outcome: ...

    def cancel(self, tasks):
        removed = [task.id for task in self._queue if task.id in tasks]
        self._queue = [task for task in self._queue if task.id not in removed]
        return removed

    @property
    def busy(self):
        return 0

    def close(self):
        self._queue = []


def answer_with(task, residuals, counts: Sequence[int], constraints=NONE) -> Outcome:
    """Answer as a worker does: not finite is a failure, and what is wanted may be reduced.

    `counts` are the residuals of each output.
    """
    if not np.isfinite(residuals).all():
        return Outcome(task.id, Status.NOT_FINITE, message="the function is not finite")
    if task.want in ("squares", "absolutes"):
        residuals = reduced(residuals, counts, task.want)
    return Outcome(task.id, Status.OK, residuals, constraints=constraints)


def reduced(residuals, counts: Sequence[int], want: str) -> np.ndarray:
    """One number in place of the residuals of each output that has some."""
    parts = [part for part in np.split(residuals, np.cumsum(counts)[:-1]) if len(part)]
    if want == "absolutes":
        return np.array([np.add.reduce(np.abs(part)) for part in parts])
    return np.array([np.sqrt(np.add.reduce(part**2)) for part in parts])
