"""Simulations on this machine, each worker's in a process of its own, without Ray."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar, Self

from typing_extensions import override

from cluster_est.executors.base import WorkerPool
from cluster_est.executors.local import LocalExecutor
from workers.messages import Experiment, Limits, Model, Outcome, Task
from workers.process.supervisor import SupervisedEvaluator


class ProcessExecutor(WorkerPool):
    """For FMUs that crash, hang, leak or exist once in a process, on the cores of one machine.

    It starts in half a second, where Ray takes several. `local` is faster for simulations of less
    than a millisecond.
    """

    name: ClassVar[str] = "processes"
    in_process: ClassVar[bool] = False

    def __init__(self, guards: Sequence[SupervisedEvaluator]) -> None:
        self.workers = len(guards)
        self._guards = list(guards)
        self._threads = LocalExecutor(guards)

    @classmethod
    @override
    def open(
        cls,
        model: Model,
        experiments: tuple[Experiment, ...],
        workers: int | None,
        address: str | None,
        limits: Limits | None = None,
    ) -> Self:
        count = model.at_most(workers or 1)
        limits = limits or Limits()
        with ThreadPoolExecutor(count) as starters:
            starting = [
                starters.submit(
                    SupervisedEvaluator, model.of_worker(i), experiments, f"process-{i}", limits
                )
                for i in range(count)
            ]
        failed = [each.exception() for each in starting if each.exception() is not None]
        guards = [each.result() for each in starting if each.exception() is None]
        if failed and failed[0] is not None:
            for guard in guards:
                guard.close()
            raise failed[0]
        return cls(guards)

    def one_worker(self, tasks: Sequence[Task], *, last: bool = False) -> list[Outcome]:
        guard = self._guards[-1 if last else 0]
        return self._threads.in_turn(tasks, lambda task: [guard.once(task)])

    def submit(self, tasks: Sequence[Task]) -> None:
        self._threads.submit(tasks)

    def completed(self) -> list[Outcome]:
        return self._threads.completed()

    def cancel(self, tasks: Collection[int]) -> list[int]:
        return self._threads.cancel(tasks)

    @property
    def busy(self) -> int:
        return self._threads.busy

    def free_instances(self, workers: int) -> None:
        self._threads.free_instances(workers)

    def close(self) -> None:
        for guard in self._guards:
            guard.stop()  # first, so that no thread waits for a simulation any more
        self._threads.close()
