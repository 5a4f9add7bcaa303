"""A running run, read repeatedly from its folder; only new data are read, and nothing is locked."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cluster_est.errors import RunFolderError
from cluster_est.html_report.activity import ActivityTail, FailureGroup
from cluster_est.run_folder.run_files import RunStatus, is_ended, left_alone, read_facts
from cluster_est.run_folder.run_progress import PROGRESS, ProgressTail
from cluster_est.running.resources import RunSnapshot
from cluster_est.watching.traces import SearchTraces, SearchView

RATE_SECONDS = 15.0
"""Time interval for the rate of simulations."""
LEFT_SECONDS = 2.0
"""Seconds without new data after which the existence of the process is checked."""


@dataclass(frozen=True)
class RunView:
    """The state of a run at the last reading of its folder.

    Attributes
    ----------
    status, message
        From run.json.
    simulations, failed, failures
        From the log.
    rate
        Recent simulations per second; NaN before the second reading.
    quiet
        Seconds without new data.
    state
        The run's own data on its workers; None before these exist.
    searches
        The search with the latest line comes last.
    facts
        Contents of run.json.
    traces
        All lines of the searches so far.
    problem
        Why the report could not be written, if requested.
    """

    status: str
    message: str
    simulations: int
    failed: int
    failures: tuple[FailureGroup, ...]
    rate: float
    quiet: float
    state: RunSnapshot | None
    searches: tuple[SearchView, ...]
    facts: Mapping[str, Any] = field(default_factory=dict, repr=False)
    traces: SearchTraces = field(default_factory=SearchTraces, repr=False)
    problem: str = ""

    @property
    def ended(self) -> bool:
        return self.status != RunStatus.RUNNING


class RunFollower:
    """Reads new data from a run folder repeatedly.

    Parameters
    ----------
    path
        Path of the run.
    clock
        Returns seconds; for tests.

    Raises
    ------
    RunFolderError
        If there is no run.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self._clock = clock
        self._facts = read_facts(path)
        self._begin()

    def _begin(self) -> None:
        self.tail = ActivityTail(self.path / "evaluations")
        self._progress = ProgressTail(self.path / PROGRESS)
        self._traces = SearchTraces()
        self._seen: deque[tuple[float, int]] = deque()
        self._moved = self._clock()

    def look(self) -> RunView:
        """Read new data, and return the state of the run."""
        started = self._facts.get("started")
        with suppress(RunFolderError):  # while it is being replaced, the last state holds
            self._facts = read_facts(self.path)
        if self._facts.get("started") != started:
            self._begin()
        self.tail.read(ended=is_ended(self._facts))
        state = self._progress.state
        for line in self._progress.new():
            self._traces.note(line)
        if self._progress.state is not state:  # a heartbeat, even without simulations
            self._moved = self._clock()
        counts = self.tail.counts
        rate = self._rate(counts.rows)
        status, quiet = str(self._facts["status"]), self._clock() - self._moved
        alone = left_alone(self.path, status) if quiet > LEFT_SECONDS else ""
        return RunView(
            status=status,
            message=str(self._facts.get("message") or "") or alone,
            simulations=counts.rows,
            failed=counts.failed,
            failures=counts.failures,
            rate=rate,
            quiet=quiet,
            state=self._progress.state,
            searches=tuple(self._traces.searches.values()),
            facts=self._facts,
            traces=self._traces,
        )

    def check(self) -> None:
        """Check that the data shown of a finished run are complete.

        Raises
        ------
        RunFolderError
            If its progress file is damaged.
        """
        self._progress.check()

    def _rate(self, rows: int) -> float:
        now = self._clock()
        if not self._seen or rows != self._seen[-1][1]:
            self._moved = now
        self._seen.append((now, rows))
        while now - self._seen[0][0] > RATE_SECONDS and len(self._seen) > 2:
            self._seen.popleft()
        then, before = self._seen[0]
        return (rows - before) / (now - then) if now > then else math.nan
