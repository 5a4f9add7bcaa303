from collections.abc import Callable, Collection, Sequence

import numpy as np

from cluster_est.executors import Executor
from workers.messages import Outcome, Task


class ShufflingExecutor(Executor):
    """Begins some tasks, in order, and ends any of those.

    Attributes
    ----------
    submitted, answered, cancelled
        Tasks, or their ids, in the order in which it happened.
    before
        Called with the number of each call of `completed`.
    """

    def __init__(
        self,
        answer: Callable[[Task], Outcome],
        seed: int = 0,
        workers: int = 3,
        before: Callable[[int], None] = lambda call: None,
    ) -> None:
        self.workers = workers
        self.submitted: list[Task] = []
        self.answered: list[Task] = []
        self.cancelled: list[int] = []
        self.before = before
        self.calls = 0
        self._answer = answer
        self._generator = np.random.default_rng(seed)
        self._queue: list[Task] = []
        self._running: list[Task] = []

    def submit(self, tasks: Sequence[Task]) -> None:
        self._queue += tasks
        self.submitted += tasks

    def completed(self) -> list[Outcome]:
        self.calls += 1
        self.before(self.calls - 1)
        room = self.workers - len(self._running)
        self._running += self._queue[:room]
        del self._queue[:room]
        assert self._running, "the runner waits for nothing"
        self._generator.shuffle(self._running)
        count = int(self._generator.integers(1, len(self._running) + 1))
        done, self._running = self._running[:count], self._running[count:]
        self.answered += done
        return [self._answer(task) for task in done]

    def cancel(self, tasks: Collection[int]) -> list[int]:
        found = [task.id for task in self._queue if task.id in set(tasks)]
        self._queue = [task for task in self._queue if task.id not in found]
        self.cancelled += found
        return found

    @property
    def busy(self) -> int:
        return min(self.workers, len(self._running) + len(self._queue))

    @property
    def waiting(self) -> int:
        """How many tasks it still has."""
        return len(self._running) + len(self._queue)

    def close(self) -> None:
        self._queue.clear()
        self._running.clear()
