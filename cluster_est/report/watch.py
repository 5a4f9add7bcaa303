"""A run followed by its folder alone, from wherever that can be read."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cluster_est.errors import RunFolderError
from cluster_est.report.activity import ActivityTail, FailureGroup
from cluster_est.report.folder import RUNNING
from cluster_est.report.page import write_report
from cluster_est.run_folder.progress_file import PROGRESS, IterationLine, ProgressTail
from cluster_est.run_folder.reading import is_ended, left_alone, read_facts
from cluster_est.running.records import RunSnapshot

RATE_SECONDS = 15.0
"""Over which the rate of simulations is taken."""
LEFT_SECONDS = 2.0
"""In which nothing has come, before it is looked whether there is a process at all."""
HTML_SECONDS = 5.0
"""At least so long between two reports."""


@dataclass(frozen=True)
class SearchView:
    """A search: its best cost so far (NaN if it has none), and its last line."""

    best: float
    last: IterationLine


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
    problem: str = ""

    @property
    def ended(self) -> bool:
        return self.status != RUNNING


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
        self._searches: dict[str, SearchView] = {}
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
        for line in self._progress.new():
            self._note(line)
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
            searches=tuple(self._searches.values()),
        )

    def check(self) -> None:
        """Check that nothing was left out of what was shown of a run that has ended.

        Raises
        ------
        RunFolderError
            If its progress is damaged.
        """
        self._progress.check()

    def _note(self, line: IterationLine) -> None:
        known = self._searches.pop(line.search, None)
        costs = [line.cost] if known is None else [line.cost, known.best]
        best = min((cost for cost in costs if not math.isnan(cost)), default=math.nan)
        self._searches[line.search] = SearchView(best, line)

    def _rate(self, rows: int) -> float:
        now = self._clock()
        if not self._seen or rows != self._seen[-1][1]:
            self._moved = now
        self._seen.append((now, rows))
        while now - self._seen[0][0] > RATE_SECONDS and len(self._seen) > 2:
            self._seen.popleft()
        then, before = self._seen[0]
        return (rows - before) / (now - then) if now > then else math.nan


def follow(path: Path, every: float, show: Callable[[RunView], None], *, html: bool) -> None:
    """Show a run until it ends, and keep its report fresh if `html`.

    Raises
    ------
    RunFolderError
        If there is no run, or what was shown of it lacks lines that are damaged.
    """
    follower = RunFollower(path)
    written, problem = -math.inf, ""
    while True:
        view = follower.look()
        now = time.monotonic()
        if html and (view.ended or now - written >= max(every, HTML_SECONDS)):
            problem = _refresh(follower, max(every, HTML_SECONDS))
            written = time.monotonic()
        show(view if not problem else RunView(**{**vars(view), "problem": problem}))
        if view.ended:
            follower.check()
            return
        time.sleep(every)


def _refresh(follower: RunFollower, reload: float) -> str:
    """Write the report; why it could not be, or nothing."""
    try:
        write_report(follower.path, reload=reload, activity=follower.tail.activity)
    except RunFolderError as error:
        return str(error)
    return ""
