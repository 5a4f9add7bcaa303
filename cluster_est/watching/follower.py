"""A run that goes on, read from its folder again and again: only what is new, nothing locked."""

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
"""Over which the rate of simulations is taken."""
LEFT_SECONDS = 2.0
"""Seconds in which nothing has come, before it is looked whether there is a process at all."""


@dataclass(frozen=True)
class RunView:
    """The state of a run when its folder is read.

    Attributes
    ----------
    status, message
        As run.json says.
    simulations, failed, failures
        Of the log.
    rate
        Simulations a second in the last seconds; NaN before there are two looks.
    quiet
        Seconds in which nothing has come.
    state
        What the run itself says of its workers; None before it has.
    searches
        The one that has moved last stands last.
    facts
        All that run.json says.
    traces
        All lines of the searches, which grow while the run is followed.
    problem
        Why the report could not be written, if that was asked for.
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
    """Looks at a run folder again and again, and reads only what is new.

    Parameters
    ----------
    path
        Of the run.
    clock
        Gives seconds; for tests.

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
        """Read what is new, and return the state of the run."""
        started = self._facts.get("started")
        with suppress(RunFolderError):  # it is being replaced: what was known before holds so long
            self._facts = read_facts(self.path)
        if self._facts.get("started") != started:
            self._begin()
        self.tail.read(ended=is_ended(self._facts))
        state = self._progress.state
        for line in self._progress.new():
            self._traces.note(line)
        if self._progress.state is not state:  # a sign of life, whether simulations come or not
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
        """Check that nothing was left out of what was shown of a run that has ended.

        Raises
        ------
        RunFolderError
            If its progress is damaged.
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
