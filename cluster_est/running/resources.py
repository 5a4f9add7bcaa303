"""The resources of a run: executor, budget and limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from threadpoolctl import threadpool_limits

from cluster_est.running.records import Budget
from workers.messages import Limits


@dataclass(frozen=True)
class Resources:
    """The executor, the budget and the limits of a fit.

    Attributes
    ----------
    executor
        "local", "processes" or "ray".
    workers
        None for every core of the cluster with "ray", and one with the others.
    address
        Of a Ray cluster; None for this machine alone.
    budget
        When to stop.
    limits
        When a simulation is ended from outside, which no executor can whose workers are in this
        process, such as "local".
    """

    executor: str = "local"
    workers: int | None = None
    address: str | None = None
    budget: Budget = field(default_factory=Budget)
    limits: Limits = field(default_factory=Limits)


def one_blas_thread() -> Any:
    """Keep linear algebra to one thread, as a context.

    The matrices are small: threads would only wait for each other while the workers use the cores,
    and sums could round differently on machines with other numbers of cores.
    """
    return threadpool_limits(limits=1, user_api="blas")
