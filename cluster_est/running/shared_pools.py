"""Workers that outlive a run: for the next one, and until what was found is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

from cluster_est.executors import WorkerPool, executor_class
from cluster_est.problem.problem import Problem
from cluster_est.running.environment import WorkerSource
from cluster_est.running.resources import Resources
from cluster_est.running.trials.reset_policy import ResetDecision, open_with_reset


class SharedPools(WorkerSource):
    """Gives each run its workers and keeps them for the next one.

    A pool is bound to a model and its experiments. It stays while runs agree in everything that
    matters to workers: those, the machine or cluster, the limits of a simulation and what it begins
    with; else its workers are replaced. A cluster is joined once, until the end. At most one pool
    is open at a time, so nothing waits for cores.
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
        # What a run left behind, stopped by its budget, must not come back in the next one.
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

    def __exit__(self, *_: object) -> None:
        self.close()


def pool_key(problem: Problem, resources: Resources) -> tuple[Any, ...]:
    """Return what two runs must agree in to use the same workers."""
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
