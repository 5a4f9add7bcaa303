"""The resources of a run: executor, budget and limits."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController

from cluster_est.running.records import Budget
from workers.fmu.seats import program_seats
from workers.messages import Limits, Model, Seats


@dataclass(frozen=True)
class Resources:
    """The executor, the budget and the limits of a fit.

    Attributes
    ----------
    executor
        "local", "processes" or "ray".
    workers
        None for every core of the cluster with "ray", and one with the others. No more are started
        than `instances`.
    address
        Of a Ray cluster; None for this machine alone.
    budget
        When to stop.
    instances
        How many instances of the FMU may exist at once over all workers, for one whose licence says
        so; None for any number.
    limits
        When a simulation is ended from outside, which no executor can whose workers are in this
        process, such as "local".
    """

    executor: str = "local"
    workers: int | None = None
    address: str | None = None
    budget: Budget = field(default_factory=Budget)
    limits: Limits = field(default_factory=Limits)
    instances: int | None = None

    @property
    def seats(self) -> Seats | None:
        """The seats of this program for instances of the FMU; None if any number may exist."""
        return None if self.instances is None else program_seats(self.instances)

    def limited(self, model: Model) -> Model:
        """Return a model whose instances are limited as here, for a process beside the workers."""
        return model if self.instances is None else replace(model, seats=self.seats)

    def notes(self) -> tuple[str, ...]:
        """What a user should know of them: that fewer workers are started than were asked for."""
        if self.instances is None or self.workers is None or self.workers <= self.instances:
            return ()
        return (
            f"executor.instances: {self.instances} of the {self.workers} workers that "
            "executor.workers asks for are started, because each has an instance of the FMU",
        )


def one_blas_thread() -> Any:
    """Keep linear algebra to one thread, as a context.

    The matrices are small: threads would only wait for each other while the workers use the cores,
    and sums could round differently on machines with other numbers of cores.
    """
    return _loaded_libraries(len(sys.modules)).limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _loaded_libraries(modules: int) -> ThreadpoolController:  # noqa: ARG001
    """Look for libraries with threads, which takes milliseconds: again only after an import."""
    return ThreadpoolController()
