"""A queue of tasks that wait for a worker, with batches of suitable size."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence

from workers.messages import Outcome, Task
from workers.wire import TaskBatch

BATCH_SECONDS = 0.1
FEW_TASKS, SECONDS_OF_FEW_TASKS = 9, 0.5
"""Largest number of tasks in a batch that exceeds `BATCH_SECONDS`, and its largest duration.

If simulations take a tenth of a second, a message for each simulation costs a small machine more
than the simulation."""
LEAST_BATCH_SECONDS = 0.005
"""Least duration of a batch, even if other workers are idle."""
FIRST_GUESS = 0.005
WEIGHT_OF_NEWEST_SECONDS = 0.2
"""Weight of the newest observation in the running mean of a simulation's seconds."""


class TaskBacklog:
    """A queue of tasks with estimates of the duration of each experiment's simulation.

    Parameters
    ----------
    shares
        Least number of batches of the whole queue, so that no worker is idle while another worker
        has all tasks.
    few_seconds
        Largest duration of a batch of a few tasks.
    """

    def __init__(self, shares: int, few_seconds: float = SECONDS_OF_FEW_TASKS) -> None:
        self._tasks: deque[Task] = deque()
        self._seconds: dict[int, float] = {}
        self._shares, self._few_seconds = shares, few_seconds

    def __len__(self) -> int:
        return len(self._tasks)

    def add(self, tasks: Iterable[Task]) -> None:
        self._tasks.extend(tasks)

    def add_first(self, task: Task) -> None:
        """Queue a task before all others, because it has waited before."""
        self._tasks.appendleft(task)

    def expected(self, batch: TaskBatch) -> float:
        """Return the expected seconds of a batch."""
        return sum(self._seconds.get(e, FIRST_GUESS) for e in batch.experiments.tolist())

    @property
    def next_seconds(self) -> float:
        """Expected seconds of the next simulation; a guess for the first of its experiment."""
        return self._seconds.get(self._tasks[0].experiment, FIRST_GUESS)

    def clear(self) -> None:
        self._tasks.clear()

    def remove(self, ids: Collection[int]) -> list[int]:
        """Remove tasks by id; return the ids that were in the queue."""
        wanted = set(ids)
        found = [task.id for task in self._tasks if task.id in wanted]
        if found:
            self._tasks = deque(task for task in self._tasks if task.id not in wanted)
        return found

    def take(self) -> TaskBatch:
        """Remove and return a batch: about 0.1 s of work or a few tasks, with one wanted result."""
        most = max(1, -(-len(self._tasks) // self._shares))
        batch: list[Task] = []
        seconds = 0.0
        while self._tasks:
            task, count = self._tasks[0], len(batch)
            few = 0 < count < FEW_TASKS and seconds + self.next_seconds <= self._few_seconds
            full = seconds >= (BATCH_SECONDS if count < most else LEAST_BATCH_SECONDS)
            if full and not (few and count < most):
                break
            if batch and (task.want, task.effects) != (batch[0].want, batch[0].effects):
                break
            self._tasks.popleft()
            batch.append(task)
            seconds += self._seconds.get(task.experiment, FIRST_GUESS)
        return TaskBatch.of(batch)

    def learn(self, batch: TaskBatch, outcomes: Sequence[Outcome]) -> None:
        """Update the estimates of durations from the outcomes of a batch."""
        for experiment, outcome in zip(batch.experiments.tolist(), outcomes, strict=True):
            known = self._seconds.get(experiment, outcome.seconds)
            self._seconds[experiment] = known + WEIGHT_OF_NEWEST_SECONDS * (outcome.seconds - known)
