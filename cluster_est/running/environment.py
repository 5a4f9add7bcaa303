"""The environment of a run: workers, budget, listeners, and the log of an earlier run.

Workers may stay open after a run, for the next run.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Self

from cluster_est.errors import ClusterEstError
from cluster_est.executors import Executor, WorkerPool, executor_class
from cluster_est.executors.executor import OutcomeSource
from cluster_est.executors.log_replay import LogReplayExecutor
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import check_process_noise
from cluster_est.running.reset_policy import ResetDecision, compared_at_the_end, open_with_reset
from cluster_est.running.resources import Budget, Note, Record, Resources, Show, TaskOrigin
from cluster_est.running.runner import Runner
from workers.messages import Outcome


@dataclass(frozen=True)
class Monitor:
    """Callbacks for the events of a run.

    Attributes
    ----------
    record, show, note
        Called for each simulation, after each group of outcomes, and for each iteration; see
        `Runner`.
    reset
        Called with the reset policy before the first recorded simulation.
    reached
        Called with an intermediate result, which is the result if the run ends after it.
    """

    record: Record | None = None
    show: Show | None = None
    note: Note | None = None
    reset: Callable[[ResetDecision], None] | None = None
    reached: Callable[[Any], None] | None = None


@dataclass(frozen=True)
class EarlierRun:
    """The outcomes and decisions of an interrupted run, for the run that resumes it.

    Attributes
    ----------
    outcomes
        Outcomes of its simulations.
    reset
        Its reset policy, if that had been decided.
    """

    outcomes: OutcomeSource
    reset: ResetDecision | None = None


class WorkerSource(ABC):
    """A source of workers, which are separate for each run or shared between runs."""

    @abstractmethod
    def lease(
        self, problem: Problem, resources: Resources, known: ResetDecision | None
    ) -> AbstractContextManager[tuple[WorkerPool, ResetDecision]]:
        """Provide workers for a problem within a context.

        Parameters
        ----------
        problem, resources
            The problem, and the executor with its limits.
        known
            The reset policy, if it was decided before.

        Raises
        ------
        ModelError, ExecutorError
            If no worker can be started.
        """


class OwnWorkers(WorkerSource):
    """Workers that are started for a run and end with it."""

    @contextmanager
    def lease(
        self, problem: Problem, resources: Resources, known: ResetDecision | None
    ) -> Iterator[tuple[WorkerPool, ResetDecision]]:
        pool, decision = open_with_reset(problem, resources, known)
        with pool:
            yield pool, decision


@dataclass(frozen=True)
class RunEnvironment:
    """The environment of a run.

    Attributes
    ----------
    resources
        The user's choices: executor, budget, limits.
    monitor
        Callbacks for the events of the run.
    earlier
        The outcomes of the interrupted run that this run resumes, if any.
    source
        The source of the workers.
    """

    resources: Resources = field(default_factory=Resources)
    monitor: Monitor = field(default_factory=Monitor)
    earlier: EarlierRun | None = None
    source: WorkerSource = field(default_factory=OwnWorkers)

    @contextmanager
    def executor(self, problem: Problem) -> Iterator[Executor]:
        """Provide an executor for a problem, with the log of the earlier run in front if any.

        Raises
        ------
        ModelError, ExecutorError
            If no worker can be started.
        """
        check_process_noise(problem)
        known = None if self.earlier is None else self.earlier.reset
        with self.source.lease(problem, self.resources, known) as (pool, decision):
            told = self.monitor.reset or (lambda _: None)
            told(decision)
            if self.earlier is None:
                yield pool
            else:
                log = self.earlier.outcomes
                yield LogReplayExecutor(pool, problem.model, problem.experiments, log)
            with suppress(ClusterEstError, KeyboardInterrupt):  # the run has its result
                after = compared_at_the_end(problem, pool, decision)
                if after != decision:
                    told(after)

    def left(self, evaluations: int, seconds: float) -> RunEnvironment:
        """Return the environment with the rest of the budget after a step.

        Parameters
        ----------
        evaluations, seconds
            Evaluations and seconds of the step.
        """
        budget = self.resources.budget
        points, time = budget.evaluations, budget.seconds
        if points is not None:
            points = max(points - evaluations, 0)
        if time is not None:
            time = max(time - seconds, 0.0)
        budget = Budget.model_construct(evaluations=points, seconds=time)  # 0 is allowed here
        rest = replace(self.resources, budget=budget)
        return replace(self, resources=rest)

    def record_of(self, problem: Problem) -> Record | None:
        """Return the monitor's record callback, which adds the experiment of a problem.

        Use it for a step whose experiments are not the experiments of the run.
        """
        record = self.monitor.record
        if record is None:
            return None

        def told(origin: TaskOrigin, outcome: Outcome) -> None:
            experiment = problem.experiments[origin.task.experiment]
            record(replace(origin, installed=(experiment.id, experiment.key)), outcome)

        return told

    def runner(
        self, executor: Executor, *, record: Record | None = None, whole: bool = False
    ) -> Runner:
        """Return a runner on an executor.

        Parameters
        ----------
        executor
            An executor of this environment.
        record
            Callback in place of the monitor's.
        whole
            See `Runner`.
        """
        monitor = self.monitor
        told = record or monitor.record
        return Runner(
            executor, self.resources.budget, told, monitor.show, monitor.note, whole=whole
        )


def open_executor(problem: Problem, resources: Resources) -> WorkerPool:
    """Start the workers for a problem; the caller closes them.

    Raises
    ------
    ModelError, ExecutorError
        If no worker can be started.
    ProblemError
        If the problem does not allow its process noise.
    """
    check_process_noise(problem)
    return open_with_reset(problem, resources)[0]


class SharedPools(WorkerSource):
    """A source of workers that keeps the workers of a run for the next run.

    The workers stay if the next run has the same `pool_key` and reset policy; otherwise they are
    replaced. A cluster is joined once, until the end. At most one pool is open at a time, so pools
    do not compete for cores.
    """

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._pool: tuple[WorkerPool, ResetDecision] | None = None
        self._leave: Callable[[], None] | None = None

    @contextmanager
    def lease(
        self, problem: Problem, resources: Resources, known: ResetDecision | None
    ) -> Iterator[tuple[WorkerPool, ResetDecision]]:
        key = (*pool_key(problem, resources), known)
        # a busy pool is replaced: simulations of a stopped run must not appear in the next run
        if self._pool is None or key != self._key or self._pool[0].busy:
            self._drop()
            kind = executor_class(resources.executor)
            if kind.on_cluster and self._leave is None:
                self._leave = kind.join(resources.workers, resources.address)
            self._pool = open_with_reset(problem, resources, known)
            self._key = key
        yield self._pool

    def _drop(self) -> None:
        if self._pool is not None:
            (pool, _), self._pool = self._pool, None
            pool.close()

    def close(self) -> None:
        """Stop the workers, and leave the cluster if it was joined here."""
        self._drop()
        if self._leave is not None:
            leave, self._leave = self._leave, None
            leave()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def pool_key(problem: Problem, resources: Resources) -> tuple[Any, ...]:
    """Return the key that two runs must share to use the same workers."""
    return (
        resources.executor,
        resources.workers,
        resources.instances,
        resources.address,
        resources.limits,
        problem.model.key,
        problem.model.reset,
        *((experiment.id, experiment.key) for experiment in problem.experiments),
    )
