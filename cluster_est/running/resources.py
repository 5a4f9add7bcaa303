"""What a run is given, executor, budget and limits, and what it tells of itself meanwhile."""

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
    """When to stop asking."""

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
    """The share of each simulation that is kept.

    What is left out is simulated again when the run is resumed, and changes no bit of it.
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
    """A task and who asked for it: what the log says of it besides its outcome.

    `installed` is (id, key) of the experiment where it is none of the problem's own. Of what is
    `slim` a log keeps no residuals: a run that is resumed simulates it again.
    """

    task: Task
    search: str
    evaluation: int
    purpose: str
    installed: tuple[str, str] | None = None
    slim: bool = False


@dataclass(frozen=True)
class RunSnapshot:
    """The state of a run as a display shows it.

    Attributes
    ----------
    search, progress
        One of those under way.
    evaluations, simulations, failures, busy, workers, seconds
        Of the whole run.
    phase
        What a recipe of several phases is about, in words.
    ended, searches
        How many of the searches that were begun together have ended, and how many these are.
    left, at_most
        Seconds that those take from now on, NaN where nobody knows; and whether they are a limit,
        set by a budget or by iterations that may not all be needed.
    waiting
        Simulations that could begin if there were more workers.
    pace
        Seconds of an iteration so far, on average, of a single search; NaN before the first.
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
    """The best point that a search has seen so far.

    Attributes
    ----------
    cost
        At it.
    violation
        Of the constraints there; 0 where they are satisfied.
    values
        Physical values by label.
    """

    cost: float
    violation: float
    values: Mapping[str, float] = field(repr=False)

    @property
    def rank(self) -> tuple[float, float]:
        """Less is better."""
        return self.violation, self.cost


@dataclass(frozen=True)
class SearchIteration:
    """A line of a search's iteration table.

    Attributes
    ----------
    search, progress
        Whose line it is, and what it says.
    evaluations
        Of this search so far.
    best
        None before a point was simulated, and of searches with very many unknowns.
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
            f"executor.instances: only {self.instances} of the {self.workers} workers in "
            "executor.workers are started, because each worker needs an instance of the FMU",
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
