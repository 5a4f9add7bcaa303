"""Simulations on this machine without Ray, in threads of this process or in worker processes.

Threads simulate at the same time because the core releases the interpreter's lock.
"""

from __future__ import annotations

import os
import queue
from collections.abc import Collection, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from typing import Any, ClassVar, Protocol, Self, final

from typing_extensions import override

from cluster_est.errors import ExecutorError
from cluster_est.executors.backlog import TaskBacklog
from cluster_est.executors.executor import WorkerPool
from workers.evaluate import Evaluator
from workers.fmu.description import describe_model
from workers.fmu.process_environment import set_environment_here
from workers.messages import Experiment, Limits, Model, Outcome, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import TaskBatch

SLOW_SECONDS = 0.5
"""Longest simulation in the caller's thread, which delays an interrupt."""
CLOSE_SECONDS = 1.0


class AnyEvaluator(Protocol):
    """An evaluator, or a proxy of an evaluator."""

    def evaluate(self, batch: TaskBatch) -> list[Outcome]: ...

    def once(self, task: Task) -> Outcome: ...

    def free_instance(self) -> None: ...

    def stop(self) -> None: ...

    def close(self) -> None: ...


@final
class EvaluatorHere:
    """An evaluator in this process, which is shared with other code.

    It restores the working folder after each batch. An instance with a fatal error cannot be freed.
    If the number of instances is limited, a replacement would exceed the limit.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator
        self._folder = ""
        with suppress(OSError):  # the folder has been removed
            self._folder = os.getcwd()
        self.free_instance, self.close = evaluator.free_instance, evaluator.close

    def evaluate(self, batch: TaskBatch) -> list[Outcome]:
        """Return the outcomes of a batch.

        Raises
        ------
        ExecutorError
            If this worker cannot have an instance any more.
        """
        outcomes = self._evaluator.evaluate(batch)
        with suppress(OSError):
            os.chdir(self._folder)
        if self._evaluator.has_lost_seat:
            raise ExecutorError(
                f"executor.instances: {self._evaluator.model.name} had a fatal error, after which "
                "its instance cannot be freed safely; another instance in this process would "
                'exceed the limit; choose executor.name = "processes" or "ray"'
            )
        return outcomes

    def once(self, task: Task) -> Outcome:
        """Return the outcome of one task."""
        return self.evaluate(TaskBatch.of([task]))[0]

    def stop(self) -> None:
        """Do nothing: a simulation in this process cannot be ended."""


class ThreadPool(WorkerPool):
    """A pool with one thread for each worker, which is an evaluator or its proxy.

    With one worker, quick simulations run in the caller's thread. Slow simulations do not, because
    they would delay an interrupt.
    """

    def __init__(self, evaluators: Sequence[AnyEvaluator]) -> None:
        self.workers = len(evaluators)
        self._evaluators = list(evaluators)
        self._idle: queue.SimpleQueue[AnyEvaluator] = queue.SimpleQueue()
        for evaluator in evaluators:
            self._idle.put(evaluator)
        self._backlog = TaskBacklog(shares=2 * self.workers)
        self._threads = ThreadPoolExecutor(self.workers)
        self._running: dict[Future[Any], TaskBatch] = {}
        self._closed = False

    def one_worker(self, tasks: Sequence[Task], *, last: bool = False) -> list[Outcome]:
        evaluator = self._evaluators[-1 if last else 0]
        outcomes: list[Outcome] = []
        for task in tasks:  # in a thread, so that an interrupt is possible
            running = self._threads.submit(evaluator.once, task)
            self._running[running] = TaskBatch.of([task])
            outcomes.append(running.result())
            del self._running[running]
        return outcomes

    def submit(self, tasks: Sequence[Task]) -> None:
        self._backlog.add(tasks)
        self._fill()

    def completed(self) -> list[Outcome]:
        if self._here:
            batch = self._backlog.take()
            outcomes = self._evaluators[0].evaluate(batch)
            self._backlog.learn(batch, outcomes)
            return outcomes
        self._fill()
        if not self._running:
            return []
        done, _ = wait(self._running, return_when=FIRST_COMPLETED)
        outcomes = []
        for future in done:
            batch = self._running.pop(future)
            answers = future.result()
            self._backlog.learn(batch, answers)
            outcomes += answers
        self._fill()
        return outcomes

    def cancel(self, tasks: Collection[int]) -> list[int]:
        return self._backlog.remove(tasks)

    @property
    def busy(self) -> int:
        waiting = len(self._backlog) if self.workers == 1 else 0
        return min(self.workers, len(self._running) + waiting)

    def free_instances(self, workers: int) -> None:
        if self._closed:
            return
        idle = [self._idle.get() for _ in self._evaluators]  # waits until no simulation runs
        for evaluator in self._evaluators[:workers]:
            evaluator.free_instance()
        for evaluator in idle:
            self._idle.put(evaluator)

    def close(self) -> None:
        for evaluator in self._evaluators:
            evaluator.stop()  # first, so that no thread waits for a simulation
        self._closed = True
        self._backlog.clear()
        _, endless = wait(self._running, CLOSE_SECONDS)
        self._threads.shutdown(wait=not endless, cancel_futures=True)
        self._running.clear()
        if not endless:  # a running simulation still needs its FMU
            for evaluator in self._evaluators:
                evaluator.close()

    @property
    def _here(self) -> bool:
        """Whether the next batch runs in the caller's thread."""
        quick = len(self._backlog) > 0 and self._backlog.next_seconds < SLOW_SECONDS
        return self.workers == 1 and not self._running and quick

    def _fill(self) -> None:
        while not self._here and self._backlog and len(self._running) < self.workers:
            batch = self._backlog.take()
            self._running[self._threads.submit(self._evaluate, batch)] = batch

    def _evaluate(self, batch: TaskBatch) -> list[Outcome]:
        evaluator = self._idle.get()
        try:
            return evaluator.evaluate(batch)
        finally:
            self._idle.put(evaluator)


class LocalExecutor(ThreadPool):
    """An executor with evaluators in this process.

    It is the default, for fits that take seconds. An FMU that crashes ends this process, and some
    FMUs do not allow several instances in one process. `processes` and `ray` avoid both problems.
    """

    name: ClassVar[str] = "local"
    in_process: ClassVar[bool] = True

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
        set_environment_here(model)
        count = model.at_most(workers or 1)
        if count > 1 and describe_model(model).once_per_process:
            count = 1
        evaluators: list[EvaluatorHere] = []
        try:
            for i in range(count):
                each = Evaluator(model.of_worker(i), experiments, f"local-{i}")
                evaluators.append(EvaluatorHere(each))
        except BaseException:
            for evaluator in evaluators:
                evaluator.close()
            raise
        return cls(evaluators)


class ProcessExecutor(ThreadPool):
    """An executor with worker processes on the cores of one machine.

    Use it for FMUs that crash, hang, leak memory or allow one instance per process. It starts in
    half a second; Ray takes several seconds. `local` is faster for simulations of less than a
    millisecond.
    """

    name: ClassVar[str] = "processes"
    in_process: ClassVar[bool] = False

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
