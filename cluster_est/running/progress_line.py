"""A line of progress for runs that were begun from Python, in a terminal or a notebook."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from cluster_est.errors import ProblemError
from cluster_est.running.heartbeat import beating
from cluster_est.running.interrupts import interrupt
from cluster_est.running.resources import Note, RunSnapshot, SearchIteration, Show
from workers.messages.checks import shown

LEAST_REDRAW_SECONDS = 0.2

SEARCH_TITLES = {
    "models": "fitting",
    "candidates": "simulating inputs",
    "refits": "fitting rivals to what each model predicts",
    "before": "simulating at the start values",
    "sample": "simulating between the bounds",
    "train": "searching",
    "screen": "screening the starts",
    "starts": "evaluating the starts",
    "derivatives": "finding the intervals",
    "directions": "finding the intervals",
    "test": "fitting the test records",
    "after": "simulating at the estimates",
}
"""Texts for people, by the names of the searches of a fit or a sensitivity analysis in the log."""

Callback = Callable[[SearchIteration], Any]
"""Called with each iteration of each search; StopIteration ends the run with what it has found."""


class _Line(Protocol):
    """A line that is renewed in place."""

    def put(self, text: str) -> None:
        """Show a text in the place of the last one."""

    def close(self) -> None:
        """Leave nothing behind."""


class _TerminalLine:
    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
        self._live.start()

    def put(self, text: str) -> None:
        from rich.text import Text

        self._live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)

    def close(self) -> None:
        self._live.stop()


class _NotebookLine:
    def __init__(self) -> None:
        from IPython.display import display  # there is no notebook without it

        self._handle: Any = display({"text/plain": ""}, raw=True, display_id=True)

    def put(self, text: str) -> None:
        self._handle.update({"text/plain": text}, raw=True)

    def close(self) -> None:
        self.put("")


def _new_line() -> _Line | None:
    """Return a line where somebody looks; None for a script whose errors go to a file."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is not None and hasattr(shell, "kernel"):
        return _NotebookLine()
    if sys.stderr is not None and sys.stderr.isatty():
        return _TerminalLine()
    return None


@contextmanager
def progress_of(given: Show | bool | None) -> Iterator[Show | None]:
    """Give what shows a run, as `progress` of `fit` says.

    Parameters
    ----------
    given
        None or True for a line in a terminal or a notebook, False for nothing, or a function.

    Raises
    ------
    ProblemError
        If it is something else.
    """
    if callable(given):
        yield given
        return
    if given not in (None, True, False):
        raise ProblemError(
            f"progress: must be true, false or a function of a snapshot but is {shown(given)}"
        )
    line = None if given is False else _new_line()
    if line is None:
        yield None
        return
    last = -math.inf

    def show(snapshot: RunSnapshot) -> None:
        nonlocal last
        if time.monotonic() - last >= LEAST_REDRAW_SECONDS:
            line.put(line_of(snapshot))
            last = time.monotonic()

    try:
        with beating(show) as forward:
            yield forward
    finally:
        line.close()


def line_of(snapshot: RunSnapshot) -> str:
    """Return a snapshot as one line of text."""
    now = snapshot.phase or SEARCH_TITLES.get(snapshot.search, snapshot.search)
    progress = snapshot.progress
    if snapshot.searches > 1:
        now = f"{now}, {snapshot.ended} of {snapshot.searches} done"
    elif progress.iteration:
        now = f"{now}, iteration {progress.iteration}"
    known = snapshot.searches == 1 and not math.isnan(progress.cost)
    parts = [
        now,
        f"cost {progress.cost:.6g}" if known else "",
        "" if math.isnan(snapshot.left) else f"about {snapshot.left:.0f} s left",
        f"{snapshot.simulations} simulations",
        f"{snapshot.failures} failed" if snapshot.failures else "",
        f"{snapshot.busy} of {snapshot.workers} workers busy",
        f"{snapshot.seconds:.0f} s",
    ]
    return " | ".join(part for part in parts if part)


def note_of(callback: Callback | None) -> Note | None:
    """Return a callback as the runner calls it."""
    if callback is None:
        return None
    if not callable(callback):
        raise ProblemError(f"callback: must be a function but is {shown(callback)}")

    stopped = False

    def note(iteration: SearchIteration) -> None:
        nonlocal stopped
        if stopped:
            return
        try:
            callback(iteration)
        except StopIteration:
            stopped = True
            interrupt()

    return note
