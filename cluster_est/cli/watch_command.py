"""The command watch: a run followed by its folder alone, as a table that is updated."""

from __future__ import annotations

import math
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from cluster_est.cli.answer import Answer
from cluster_est.cli.live_page import browse
from cluster_est.cli.parent_process import ExitCode
from cluster_est.errors import RunFolderError
from cluster_est.html_report.number_text import count, duration
from cluster_est.html_report.page import write_report
from cluster_est.run_folder.run_files import left_alone
from cluster_est.run_folder.run_progress import left_of_step, pace_of, what_is_done
from cluster_est.running.resources import RunSnapshot
from cluster_est.screen import LiveLines, Screen, aligned
from cluster_est.watching.follower import RunFollower, RunView
from cluster_est.watching.traces import SearchView

MOST_SEARCHES, MOST_FAILURE_REASONS = 12, 5
QUIET_SECONDS = 30.0
"""Seconds after which a sentence says that nothing comes."""


def watch(options: Namespace, answer: Answer) -> int:
    """Follow a run until it ends; look once where a document is asked for."""
    if options.browser:
        browse(options, answer)
        return ExitCode.DONE
    if options.json:
        follower = RunFollower(options.run_folder)
        view = follower.look()
        view = replace(view, message=view.message or left_alone(options.run_folder, view.status))
        if options.html:
            view = replace(view, problem=_refresh(follower, max(options.every, HTML_SECONDS)))
        for sentence in sentences(view):
            answer.say(sentence)
    else:
        with WatchTable(Screen(sys.stdout)) as table:
            view = follow(options.run_folder, options.every, table.show, html=options.html)
    answer.add(**_fields(options.run_folder, view))
    return ExitCode.DONE


def _fields(run_folder: Path, view: RunView) -> dict[str, Any]:
    """Return the fields of a view; what only the run itself says is None without it."""
    state = view.state
    return {
        "run": run_folder,
        "run_status": view.status,
        "doing": None if state is None or view.ended else _now(state),
        "seconds": None if state is None else state.seconds,
        "evaluations": None if state is None else state.evaluations,
        "workers": None if state is None else state.workers,
        "busy": None if state is None else state.busy,
        "simulations": view.simulations,
        "failures": view.failed,
        "searches": [
            {
                "search": each.last.search,
                "iteration": each.last.iteration,
                "evaluations": each.last.evaluations,
                "best": each.best,
                "cost": each.last.cost,
                "ending": each.last.ending,
            }
            for each in view.searches
        ],
        "failure_reasons": [
            {"count": each.count, "status": each.status, "message": each.message}
            for each in view.failures
        ],
    }


class WatchTable:
    """Shows views in place on a terminal; elsewhere only the last one, as lines.

    Parameters
    ----------
    screen
        Where to.
    """

    def __init__(self, screen: Screen) -> None:
        self._screen = screen
        self._live = LiveLines(screen, stay=True)
        self._last: RunView | None = None

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__()
        if self._last is not None and not self._screen.is_terminal:
            self._screen.print("\n".join(rendered(self._last)))

    def show(self, view: RunView) -> None:
        """Renew the table."""
        self._last = view
        self._live.put(rendered(view))


def rendered(view: RunView) -> list[str]:
    """Return the sentences and tables of a view as lines."""
    lines = sentences(view)
    problem = [lines.pop()] if view.problem else []
    return [*lines, *_searches(view.searches), *_failures(view), *problem]


def sentences(view: RunView) -> list[str]:
    """Return what a view says beside its tables."""
    said = [_head(view), _numbers(view)]
    if view.state is not None and not view.ended:
        said.insert(1, _now(view.state))
    if view.message:
        said.append(view.message)
    if not view.ended and view.quiet > QUIET_SECONDS:
        said.append(f"nothing has come for {duration(view.quiet)}, not even a sign of life")
    if view.problem:
        said.append(f"the report could not be written: {view.problem}")
    return said


def _head(view: RunView) -> str:
    state = view.state
    elapsed = f", {duration(state.seconds)}" if state is not None else ""
    return f"{view.status}{elapsed}"


def _now(state: RunSnapshot) -> str:
    done = what_is_done(state.search, state.phase, state.ended, state.searches)
    left = left_of_step(state.phase, state.left, at_most=state.at_most)
    return " | ".join(part for part in (done, left, pace_of(state.pace)) if part)


def _numbers(view: RunView) -> str:
    state = view.state
    parts = [f"{count(view.simulations)} simulations ({count(view.failed)} failed)"]
    if state is not None:
        parts.insert(0, f"{count(state.evaluations)} evaluations")
    if not view.ended:
        if not math.isnan(view.rate):
            parts.append(f"{view.rate:.3g} simulations/s")
        if state is not None:
            parts.append(f"{state.busy}/{state.workers} workers busy")
    return " | ".join(parts)


def _searches(searches: tuple[SearchView, ...]) -> list[str]:
    rows = [("search", "iteration", "evaluations", "best cost", "cost", "")]
    for each in searches[-MOST_SEARCHES:]:
        line = each.last
        rows.append((
            line.search, str(line.iteration), str(line.evaluations), _cost(each.best),
            _cost(line.cost), line.ending,
        ))  # fmt: skip
    left = f"the last {MOST_SEARCHES} of {len(searches)}"
    shown = aligned(rows, numeric=(1, 2, 3, 4)) if searches else []
    return [*shown, left] if len(searches) > MOST_SEARCHES else shown


def _cost(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _failures(view: RunView) -> list[str]:
    failures = view.failures[:MOST_FAILURE_REASONS]
    rows = [
        ("failed", "status", "reason"),
        *((str(f.count), f.status, f.message) for f in failures),
    ]
    left = f"and {len(view.failures) - MOST_FAILURE_REASONS} other reasons"
    shown = aligned(rows, numeric=(0,)) if failures else []
    return [*shown, left] if len(view.failures) > MOST_FAILURE_REASONS else shown


HTML_SECONDS = 5.0
"""Least seconds between two reports."""


def follow(path: Path, every: float, show: Callable[[RunView], None], *, html: bool) -> RunView:
    """Show a run until it ends, keep its report fresh if `html`, and return the last view.

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
        show(replace(view, problem=problem))
        if view.ended:
            follower.check()
            return view
        time.sleep(every)


def _refresh(follower: RunFollower, reload: float) -> str:
    """Write the report; why it could not be, or nothing."""
    try:
        write_report(follower.path, reload=reload, activity=follower.tail.activity)
    except RunFolderError as error:
        return str(error)
    return ""
