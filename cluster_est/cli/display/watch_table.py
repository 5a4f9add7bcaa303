"""The table that `watch` shows and updates."""

from __future__ import annotations

import math
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cluster_est.report.numbers import count, duration
from cluster_est.report.watch import RunView, SearchView
from cluster_est.run_folder.progress_text import left_of_step, pace_of, what_is_done
from cluster_est.running.records import RunSnapshot

MOST_SEARCHES, MOST_FAILURES = 12, 5
QUIET_SECONDS = 30.0
"""After these it is worth a sentence that nothing comes."""


class WatchTable:
    """Shows views in place on a terminal; elsewhere only the last one, as lines.

    Parameters
    ----------
    console
        Where to.
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
        """Renew the table."""
        self._last = view
        if self._console.is_terminal:
            self._live.update(rendered(view), refresh=True)


def rendered(view: RunView) -> Group:
    """The lines and tables of a view."""
    parts: list[Text | Table] = [Text(_head(view), style="bold"), Text(_numbers(view))]
    if view.state is not None and not view.ended:
        parts.insert(1, Text(_now(view.state)))
    if view.message:
        parts.append(Text(view.message))
    if not view.ended and view.quiet > QUIET_SECONDS:
        parts.append(
            Text(f"nothing has come for {duration(view.quiet)}; the run may have been killed")
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
        table.caption = f"the last {MOST_SEARCHES} of {len(searches)}"
    return table


def _cost(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _failures(view: RunView) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("failed", justify="right")
    table.add_column("status")
    table.add_column("reason")
    for each in view.failures[:MOST_FAILURES]:
        table.add_row(str(each.count), Text(each.status), Text(each.message))
    if len(view.failures) > MOST_FAILURES:
        table.caption = f"and {len(view.failures) - MOST_FAILURES} other reasons"
    return table
