"""Resources of a run (executor, budget, limits), and the records of its progress."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar

from pydantic import Field
from threadpoolctl import ThreadpoolController

from cluster_est.methods.method import Progress
from cluster_est.settings import Count, Finite, Settings
from workers.fmu.seats import program_seats
from workers.messages import Limits, Model, Outcome, Seats, Task


class Budget(Settings):
    """Limits after which no new points are requested."""

    section: ClassVar[str] = "budget"

    evaluations: Count | None = Field(
        None,
        gt=0,
        description="largest number of points that all searches together may evaluate; each point "
        "is a simulation of all experiments",
    )
    seconds: Finite | None = Field(
        None, gt=0.0, description="time in seconds after which no new points are requested"
    )


class LogSettings(Settings):
    """The parts of each simulation that the log keeps.

    A resumed run simulates the missing parts again, with the same bits.
    """

    section: ClassVar[str] = "log"

    residuals: bool = Field(
        True,
        description="false: residuals and trajectories are not written; a resumed run computes "
        "them again",
    )
    keep_residuals: bool = Field(
        False,
        description="true: residuals and trajectories stay in the log when the run is done; false: "
        "only their hashes stay",
    )
    max_megabytes: Finite = Field(
        1024.0,
        ge=0.0,
        description="size of the log in MB above which residuals and trajectories of the oldest "
        "simulations are removed; about 270 bytes of each simulation stay; 0: no limit",
    )


@dataclass(frozen=True)
class TaskOrigin:
    """A task and its origin, for the log.

    `installed` is (id, key) of the experiment if it is not an experiment of the problem. The log
    keeps no residuals of a `slim` task; a resumed run simulates it again.
    """

    task: Task
    search: str
    evaluation: int
    purpose: str
    installed: tuple[str, str] | None = None
    slim: bool = False


@dataclass(frozen=True)
class RunSnapshot:
    """The state of a run for a display.

    Attributes
    ----------
    search, progress
        Name and progress of one of the running searches.
    evaluations, simulations, failures, busy, workers, seconds
        Numbers and seconds of the whole run.
    phase
        Text of the current phase, in a recipe of several phases.
    ended, searches
        Number of ended searches, and of all searches, in the current group.
    left, at_most
        Remaining seconds of the current group (NaN if unknown), and whether this is an upper limit.
    waiting
        Number of simulations that wait for a worker.
    pace
        Mean seconds of an iteration of a single search; NaN before the first iteration.
    """

    search: str
    progress: Progress
    evaluations: int
    simulations: int
    failures: int
    busy: int
    workers: int
    seconds: float
    phase: str = ""
    ended: int = 0
    searches: int = 1
    left: float = math.nan
    waiting: int = 0
    at_most: bool = True
    pace: float = math.nan


@dataclass(frozen=True)
class BestPoint:
    """The best point of a search so far.

    Attributes
    ----------
    cost
        Cost at the point.
    violation
        Violation of the constraints; 0 if they are satisfied.
    values
        Physical values by label.
    """

    cost: float
    violation: float
    values: Mapping[str, float] = field(repr=False)

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, best first."""
        return self.violation, self.cost


@dataclass(frozen=True)
class SearchIteration:
    """A line of a search's iteration table.

    Attributes
    ----------
    search, progress
        Name of the search, and contents of the line.
    evaluations
        Number of evaluations of this search so far.
    best
        The best point; None before the first simulated point, or with very many unknowns.
    """

    search: str
    progress: Progress
    evaluations: int
    best: BestPoint | None = None


Record = Callable[[TaskOrigin, Outcome], None]
Show = Callable[[RunSnapshot], None]
Note = Callable[[SearchIteration], None]


@dataclass(frozen=True)
class Resources:
    """The executor, the budget and the limits of a fit.

    Attributes
    ----------
    executor
        "local", "processes" or "ray".
    workers
        Number of workers, at most `instances`. None selects every core of the cluster with "ray",
        and one worker with the other executors.
    address
        Address of a Ray cluster; None for this machine alone.
    budget
        Limits of evaluations and seconds.
    instances
        Largest number of instances of the FMU at the same time, over all workers, for FMUs with
        such a licence; None for any number.
    limits
        Limits after which a simulation is ended from outside. Executors with workers in this
        process, such as "local", cannot end a simulation.
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
        """Return a model with this limit of instances, for a process in addition to the workers."""
        return model if self.instances is None else replace(model, seats=self.seats)

    def notes(self) -> tuple[str, ...]:
        """Return notes for the user: a note if fewer workers are started than requested."""
        if self.instances is None or self.workers is None or self.workers <= self.instances:
            return ()
        return (
            f"executor.instances: only {self.instances} of the {self.workers} workers in "
            "executor.workers are started, because each worker needs an instance of the FMU",
        )


def one_blas_thread() -> Any:
    """Return a context that limits linear algebra to one thread.

    The matrices are small, and the workers use the cores. With several threads, sums could also
    round differently on machines with other numbers of cores.
    """
    return _loaded_libraries(len(sys.modules)).limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _loaded_libraries(modules: int) -> ThreadpoolController:  # noqa: ARG001
    """Return the controller of thread libraries; a new search (milliseconds) after imports only."""
    return ThreadpoolController()
