"""Workers with virtual clocks: for studies of scheduling, where no simulation runs."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import ClassVar, Self

import numpy as np

from cluster_est.executors.base import Executor
from workers.messages import Experiment, FloatArray, Limits, Model, Outcome, Status, Task

Answer = Callable[[Task], FloatArray]
Seconds = Callable[[Task, np.random.Generator], float]


class VirtualExecutor(Executor):
    """Answers with the values of functions, at the times at which workers would have them.

    For studies of how methods use workers that simulations keep busy for different times. Nothing
    sleeps: a clock jumps from one end of a task to the next. The coordinator's own work takes no
    virtual time, and a task travels alone and at once. It is not for users' fits, so no config can
    choose it.

    Parameters
    ----------
    residuals
        Of a task; values that are not finite count as a failed simulation.
    seconds
        How long a task keeps its worker busy. The generator given to it is the same for the same
        number of a task, whatever ran before and on however many workers; infinite for one that
        never ends.
    workers
        How many there are. Each takes the task that has waited longest.
    constraints
        Of a task; none if left out.
    seed
        Of those generators.

    Attributes
    ----------
    now
        Virtual seconds since the beginning.
    """

    name: ClassVar[str] = "virtual"

    def __init__(
        self,
        residuals: Answer,
        seconds: Seconds,
        workers: int = 1,
        constraints: Answer | None = None,
        seed: int = 0,
    ) -> None:
        self.workers = workers
        self.now = 0.0
        self._residuals = residuals
        self._constraints = constraints or (lambda task: np.zeros(0))
        self._seconds = seconds
        self._seed = seed
        self._queue: deque[Task] = deque()
        self._running: list[tuple[float, int, float, Task]] = []  # end, id, begin
        self._worked = 0.0

    @classmethod
    def open(
        cls,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        address: str | None,
        limits: Limits | None = None,
    ) -> Self:
        raise NotImplementedError("a virtual executor is made from functions, not from a model")

    def submit(self, tasks: Sequence[Task]) -> None:
        self._queue.extend(tasks)
        self._begin()

    def completed(self) -> list[Outcome]:
        """Advance the clock to the end of the next task; all that end at that moment."""
        if not self._running:
            return []
        outcomes: list[Outcome] = []
        self.now = self._running[0][0]
        if self.now == np.inf:
            raise RuntimeError("every worker is busy with a task that never ends")
        while self._running and self._running[0][0] <= self.now:
            end, _, begin, task = heapq.heappop(self._running)
            self._worked += end - begin
            outcomes.append(self._answer(task, end - begin))
        self._begin()
        return outcomes

    def cancel(self, tasks: Collection[int]) -> list[int]:
        wanted = set(tasks)
        found = [task.id for task in self._queue if task.id in wanted]
        self._queue = deque(task for task in self._queue if task.id not in wanted)
        return found

    @property
    def busy(self) -> int:
        return len(self._running)

    @property
    def busy_share(self) -> float:
        """Part of the workers' time so far in which they had something to do."""
        under_way = sum(self.now - begin for _, _, begin, _ in self._running)
        return (self._worked + under_way) / (self.workers * self.now) if self.now > 0.0 else 0.0

    def close(self) -> None:
        self._queue.clear()
        self._running.clear()

    def _begin(self) -> None:
        while self._queue and len(self._running) < self.workers:
            task = self._queue.popleft()
            seconds = self._seconds(task, np.random.default_rng([self._seed, task.id]))
            heapq.heappush(self._running, (self.now + seconds, task.id, self.now, task))

    def _answer(self, task: Task, seconds: float) -> Outcome:
        with np.errstate(all="ignore"):
            residuals = np.asarray(self._residuals(task), np.float64)
            constraints = np.asarray(self._constraints(task), np.float64)
        if not np.isfinite(residuals).all():
            message = "the residuals are not finite"
            return Outcome(task.id, Status.NOT_FINITE, message=message, seconds=seconds)
        return Outcome(
            task.id,
            Status.OK,
            residuals,
            seconds=seconds,
            worker="virtual",
            constraints=constraints,
        )
