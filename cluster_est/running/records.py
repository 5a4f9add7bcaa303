"""Records that a runner takes and gives: budget, origin of a task, progress of a search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from pydantic import Field

from cluster_est.methods.method import Progress
from cluster_est.settings import Count, Finite, Settings
from workers.messages import Outcome, Task


class Budget(Settings):
    """When to stop asking."""

    section: ClassVar[str] = "budget"

    evaluations: Count | None = Field(
        None,
        gt=0,
        description="points to evaluate at most, each with all experiments, of all searches "
        "together",
    )
    seconds: Finite | None = Field(None, gt=0.0, description="after which nothing new is asked")


class LogSettings(Settings):
    """The share of each simulation that is kept.

    What is left out is simulated again when the run is resumed, and changes no bit of it.
    """

    section: ClassVar[str] = "log"

    residuals: bool = Field(
        True,
        description="false: leave residuals and trajectories out; a resumed run computes them anew",
    )
    keep_residuals: bool = Field(
        False,
        description="true: they stay in the log when the run is done; else only their hashes do",
    )
    max_megabytes: Finite = Field(
        1024.0,
        ge=0.0,
        description="size beyond which the oldest simulations lose theirs, all but some 270 bytes "
        "of each; 0: no limit",
    )


@dataclass(frozen=True)
class TaskOrigin:
    """A task and who asked for it: what the log says of it besides its outcome.

    `installed` is (id, key) of the experiment where it is none of the problem's own.
    """

    task: Task
    search: str
    evaluation: int
    purpose: str
    installed: tuple[str, str] | None = None


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
        Seconds of an iteration so far, on average, of a single search; NaN where there is none.
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
class SearchIteration:
    """A line of a search's iteration table; `evaluations` are those of this search so far."""

    search: str
    progress: Progress
    evaluations: int


Record = Callable[[TaskOrigin, Outcome], None]
Show = Callable[[RunSnapshot], None]
Note = Callable[[SearchIteration], None]
