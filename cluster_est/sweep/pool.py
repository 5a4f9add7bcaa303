"""Workers that outlive a run of a sweep."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from cluster_est.executors import Executor
from cluster_est.problem.problem import Problem
from cluster_est.running.resources import Resources, open_executor


class SharedPools:
    """Gives each run its workers and keeps them for the next one.

    A pool is bound to a model and its experiments. It stays while runs ask for the same ones, on
    the same machine or cluster; else its workers are replaced. Ray itself is started once and stays
    until the end. At most one pool is open at a time, so nothing waits for cores.
    """

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._executor: Executor | None = None
        self._connected = False

    def open(self, problem: Problem, resources: Resources) -> Executor:
        """The workers for a problem; they must not be closed.

        Raises
        ------
        ModelError, ExecutorError
            If there are none to be had.
        """
        key = pool_key(problem, resources)
        # What a run left behind, stopped by its budget, must not come back in the next one.
        if self._executor is None or key != self._key or self._executor.busy:
            self._drop()
            if resources.executor == "ray":
                self._connected |= _connect(resources)
            self._executor = open_executor(problem, resources)
            self._key = key
        return self._executor

    def _drop(self) -> None:
        if self._executor is not None:
            executor, self._executor = self._executor, None
            executor.close()

    def close(self) -> None:
        """Stop the workers, and Ray if it was started here."""
        self._drop()
        if self._connected:
            from cluster_est.executors.ray_cluster import disconnect

            self._connected = False
            disconnect()

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
    """Two runs with the same key can use the same workers."""
    return (
        resources.executor,
        resources.workers,
        resources.address,
        problem.model.key,
        *((experiment.id, experiment.key) for experiment in problem.experiments),
    )


def _connect(resources: Resources) -> bool:
    from cluster_est.executors.ray_cluster import connect  # a second to import

    return connect(resources.workers, resources.address)
