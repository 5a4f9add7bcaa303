"""Where a run happens, and for how long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from threadpoolctl import threadpool_limits

from cluster_est.executors import Executor
from cluster_est.executors.log_replay import LogReplayExecutor
from cluster_est.problem.problem import Problem
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.running.reset_policy import ResetDecision, open_renewing
from cluster_est.running.runner import Budget
from workers.messages import Limits


@dataclass(frozen=True)
class Resources:
    """Where a fit runs and how long it may take.

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
        When a simulation is ended from outside; "local" cannot do that.
    log
        What an interrupted run has simulated already, if this one takes it up again.
    renew
        What that run's simulations began with, if it had to be chosen.
    chosen
        Told what every simulation begins with, before the first simulation that counts.
    """

    executor: str = "local"
    workers: int | None = None
    address: str | None = None
    budget: Budget = field(default_factory=Budget)
    limits: Limits = field(default_factory=Limits)
    log: LoggedOutcomes | None = field(default=None, repr=False, compare=False)
    renew: ResetDecision | None = None
    chosen: Callable[[ResetDecision], None] | None = field(default=None, repr=False, compare=False)


def one_blas_thread() -> Any:
    """Keep linear algebra to one thread, as a context.

    The matrices are small: threads would only wait for each other while the workers use the cores,
    and sums could round differently on machines with other numbers of cores.
    """
    return threadpool_limits(limits=1, user_api="blas")


def open_executor(problem: Problem, resources: Resources) -> Executor:
    """Start the workers for a problem; behind the log, if there is one."""
    where = resources.executor, resources.workers, resources.address, resources.limits
    executor, chosen = open_renewing(problem, *where, resources.renew)
    if resources.chosen is not None:
        resources.chosen(chosen)
    if resources.log is None:
        return executor
    return LogReplayExecutor(executor, problem.model, problem.experiments, resources.log)
