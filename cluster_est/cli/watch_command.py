"""The command watch: a run followed by its folder alone, as a table that is updated."""

from __future__ import annotations

import math
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cluster_est.cli.answer import Answer
from cluster_est.cli.live_page import browse
from cluster_est.cli.parent_process import ExitCode
from cluster_est.errors import RunFolderError
from cluster_est.html_report.number_text import count, duration
from cluster_est.html_report.page import write_report
from cluster_est.run_folder.run_files import left_alone
from cluster_est.running.progress_line import left_of_step, pace_of, what_is_done
from cluster_est.running.resources import RunSnapshot
from cluster_est.watching.follower import RunFollower, RunView
from cluster_est.watching.page_sources import runs_below
from cluster_est.watching.page_state import RunRow
from cluster_est.watching.traces import SearchView

MOST_SEARCHES, MOST_FAILURE_REASONS = 12, 5
QUIET_SECONDS = 30.0
"""Seconds without new data after which a sentence reports it."""


def watch(options: Namespace, answer: Answer) -> int:
    """Follow a run until it ends; look once where a document is asked for."""
    if options.browser:
        browse(options, answer)
        return ExitCode.DONE
    if options.json and not options.html and (names := _runs_of(options.run_folder)):
        _look_at_runs(options.run_folder, names, answer)
        return ExitCode.DONE
    if options.json:
        follower = RunFollower(options.run_folder)
        view = follower.look()
        view = replace(view, message=view.message or left_alone(options.run_folder, view.status))
        if options.html:
            view = replace(view, problem=_refresh(follower, max(options.every, HTML_SECONDS)))
        for part in rendered(view).renderables:
            if isinstance(part, Text):
                answer.say(part.plain)
    else:
        with WatchTable(Console()) as table:
            view = follow(options.run_folder, options.every, table.show, html=options.html)
    answer.add(**_fields(options.run_folder, view))
    return ExitCode.DONE


def _runs_of(folder: Path) -> list[str]:
    """Return the names of the runs in a folder that is not itself a run."""
    return [] if (folder / "run.json").is_file() else runs_below(folder)


def _look_at_runs(folder: Path, names: Sequence[str], answer: Answer) -> None:
    """Print the state of each run in a folder."""
    rows = [RunRow(folder / name, name).look() for name in names]
    for row in rows:
        cost = "" if row.get("cost") is None else f"cost {row['cost']:.6g}"
        said = [row["status"], row.get("verdict"), cost, row.get("doing"), row.get("message")]
        answer.say(f"{row['name']}: {', '.join(filter(None, said))}")
    kept = [{key: value for key, value in row.items() if key not in ("line", "of")} for row in rows]
    answer.add(run=folder, runs=kept)


def _fields(run_folder: Path, view: RunView) -> dict[str, Any]:
    """Return the fields of a view; data that only the run itself reports may be None."""
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
    """Shows views in place on a terminal; elsewhere, it prints only the last view.

    Parameters
    ----------
    console
        The console.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False)
        self._last: RunView | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()
        elif self._last is not None:
            self._console.print(rendered(self._last))

    def show(self, view: RunView) -> None:
        """Update the table."""
        self._last = view
        if self._console.is_terminal:
            self._live.update(rendered(view), refresh=True)


def rendered(view: RunView) -> Group:
    """Return the lines and tables of a view."""
    parts: list[Text | Table] = [Text(_head(view), style="bold"), Text(_numbers(view))]
    if view.state is not None and not view.ended:
        parts.insert(1, Text(_now(view.state)))
    if view.message:
        parts.append(Text(view.message))
    if not view.ended and view.quiet > QUIET_SECONDS:
        parts.append(
            Text(
                f"the run has written nothing for {duration(view.quiet)}, although a live run "
                "writes every few seconds: it may hang, be paused, or have been killed"
            )
        )
    if view.searches:
        parts.append(_searches(view.searches))
    if view.failures:
        parts.append(_failures(view))
    if view.problem:
        parts.append(Text(f"the report could not be written: {view.problem}"))
    return Group(*parts)


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


def _searches(searches: tuple[SearchView, ...]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("search")
    for name in ("iteration", "evaluations", "best cost", "cost"):
        table.add_column(name, justify="right")
    table.add_column("")
    for each in searches[-MOST_SEARCHES:]:
        line = each.last
        table.add_row(
            Text(line.search),
            str(line.iteration),
            str(line.evaluations),
            _cost(each.best),
            _cost(line.cost),
            Text(line.ending),
        )
    if len(searches) > MOST_SEARCHES:
        table.caption = f"the last {MOST_SEARCHES} of {len(searches)} searches"
    return table


def _cost(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _failures(view: RunView) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("failed", justify="right")
    table.add_column("status")
    table.add_column("reason")
    for each in view.failures[:MOST_FAILURE_REASONS]:
        table.add_row(str(each.count), Text(each.status), Text(each.message))
    if len(view.failures) > MOST_FAILURE_REASONS:
        table.caption = f"and {len(view.failures) - MOST_FAILURE_REASONS} other reasons"
    return table


HTML_SECONDS = 5.0
"""Shortest interval between two reports in seconds."""


def follow(path: Path, every: float, show: Callable[[RunView], None], *, html: bool) -> RunView:
    """Show a run until it ends, update its report if `html`, and return the last view.

    Raises
    ------
    RunFolderError
        If there is no run, or lines that were shown of it are damaged.
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
    """Write the report; return why it could not be written, or ""."""
    try:
        write_report(follower.path, reload=reload, activity=follower.tail.activity)
    except RunFolderError as error:
        return str(error)
    return ""
