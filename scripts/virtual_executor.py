"""Workers with virtual clocks, for studies of scheduling without simulations."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Collection, Sequence

import numpy as np

from cluster_est.executors.executor import Executor
from workers.messages import FloatArray, Outcome, Status, Task

Answer = Callable[[Task], FloatArray]
Clock = Callable[[], float]
Seconds = Callable[[Task, np.random.Generator], float]


class VirtualExecutor(Executor):
    """Answers with the values of functions, at the times at which workers would finish.

    It is for studies of how methods use workers with different simulation times. Nothing sleeps: a
    clock jumps from one end of a task to the next. Each task is sent alone and without delay. The
    coordinator's own work takes no virtual time unless a clock measures it.

    Parameters
    ----------
    residuals
        Returns the residuals of a task; values that are not finite mean a failed simulation. It may
        return all residuals for a reduced answer, unless the method keeps outputs apart.
    seconds
        Returns how long a task keeps its worker busy. Its generator depends only on the number of
        the task, and not on earlier tasks or the number of workers. Infinite for a task that never
        ends.
    workers
        Number of workers. Each takes the task that has waited longest.
    constraints
        Returns the constraints of a task; by default, there are none.
    seed
        Seed of those generators.
    clock
        Returns seconds. Time that passes on it while the coordinator works also passes on the
        virtual clock. Meanwhile, workers continue with queued tasks, and are idle without any.

    Attributes
    ----------
    now
        Virtual seconds since the beginning.
    coordinator
        Virtual seconds in which the coordinator has worked.
    """

    def __init__(
        self,
        residuals: Answer,
        seconds: Seconds,
        workers: int = 1,
        constraints: Answer | None = None,
        seed: int = 0,
        clock: Clock | None = None,
    ) -> None:
        self.workers = workers
        self.now = 0.0
        self.coordinator = 0.0
        self._residuals = residuals
        self._constraints = constraints or (lambda task: np.zeros(0))
        self._seconds = seconds
        self._seed = seed
        self._queue: deque[tuple[float, Task]] = deque()  # when it was submitted
        self._running: list[tuple[float, int, float, Task]] = []  # end, id, begin
        self._worked = 0.0
        self._clock = clock or (lambda: 0.0)
        self._left = self._clock()

    def submit(self, tasks: Sequence[Task]) -> None:
        self._resume()
        self._queue.extend((self.now, task) for task in tasks)
        self._begin(self.now)
        self._left = self._clock()

    def completed(self) -> list[Outcome]:
        """Return all outcomes that ended meanwhile; otherwise advance to the next end of a task."""
        self._resume()
        outcomes: list[Outcome] = []
        if self._running:
            self.now = max(self.now, self._running[0][0])
        if self.now == np.inf:
            raise RuntimeError("every worker is busy with a task that never ends")
        while self._running and self._running[0][0] <= self.now:
            moment = self._running[0][0]
            while self._running and self._running[0][0] <= moment:
                end, _, begin, task = heapq.heappop(self._running)
                self._worked += end - begin
                outcomes.append(self._answer(task, end - begin))
            self._begin(moment)
        self._left = self._clock()
        return outcomes

    def cancel(self, tasks: Collection[int]) -> list[int]:
        self._resume()
        wanted = set(tasks)
        found = [task.id for _, task in self._queue if task.id in wanted]
        self._queue = deque(queued for queued in self._queue if queued[1].id not in wanted)
        self._left = self._clock()
        return found

    @property
    def busy(self) -> int:
        return len(self._running)

    @property
    def busy_share(self) -> float:
        """Share of the workers' time so far in which they were busy."""
        under_way = sum(min(end, self.now) - begin for end, _, begin, _ in self._running)
        return (self._worked + under_way) / (self.workers * self.now) if self.now > 0.0 else 0.0

    def close(self) -> None:
        self._queue.clear()
        self._running.clear()

    def _resume(self) -> None:
        """Advance by the time that the coordinator has worked."""
        worked = self._clock() - self._left
        self.now += worked
        self.coordinator += worked

    def _begin(self, moment: float) -> None:
        """Give queued tasks to idle workers, at the end of the last task."""
        while self._queue and len(self._running) < self.workers:
            submitted, task = self._queue.popleft()
            begin = max(moment, submitted)
            seconds = self._seconds(task, np.random.default_rng([self._seed, task.id]))
            heapq.heappush(self._running, (begin + seconds, task.id, begin, task))

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
