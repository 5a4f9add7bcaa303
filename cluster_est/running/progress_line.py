"""The progress line of a run, in a terminal or a notebook."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from cluster_est.errors import ProblemError
from cluster_est.running.heartbeat import STARTING, beating
from cluster_est.running.interrupts import interrupt
from cluster_est.running.resources import Budget, Note, RunSnapshot, SearchIteration, Show
from workers.messages.checks import shown

if TYPE_CHECKING:
    from rich.console import Console

SECONDS_BETWEEN_REDRAWS = 0.1

SEARCH_TITLES = {
    "models": "fitting",
    "candidates": "simulating inputs",
    "refits": "fitting each model to the predictions of the others",
    "before": "simulating at the start values",
    "sample": "simulating between the bounds",
    "train": "searching",
    "screen": "screening the starts",
    "starts": "evaluating the starts",
    "derivatives": "computing the intervals",
    "directions": "computing the intervals",
    "test": "fitting the test records",
    "after": "simulating at the estimates",
    "weights": "weighting the outputs",
    "base": "fitting the declared model",
    "leave one out": "predicting experiments that were left out",
    "course": "screening the candidates",
    "tests": "testing the candidates",
    "probe": "screening the candidates",
    "trial": "trying candidates",
    "candidate": "refitting candidates",
    "enlarged": "simulating with larger inputs",
    "drop": "revising the effects",
    "final": "the final fits",
    "process noise": "fitting the process noise",
    "sizes": "measuring the influence of each unknown",
    "gaps": "simulating across gaps",
    "sensors": "estimating the start values of sensors",
    "segments": "simulating segments",
    "records": "testing the records for faults",
    "shapes": "computing the shapes of the effects",
    "posterior": "drawing from the posterior",
    "predictions": "simulating predictions",
    "start": "searching from start",
    "profile": "computing the profile of",
    "bootstrap": "refitting draw",
}
"""Texts for users, by the names of searches in the log.

A name such as "start 3" has the text of its first word, followed by the rest.
"""

Callback = Callable[[SearchIteration], Any]
"""Called with each iteration of each search; StopIteration ends the run with its result so far."""


class Place(Protocol):
    """A display of one line."""

    def put(self, text: str) -> None:
        """Show a text in place of the last text."""

    def close(self) -> None:
        """Remove the line."""


class TerminalPlace:
    """A line of a terminal that is updated in place, and truncated to one line."""

    def __init__(self, console: Console) -> None:
        from rich.live import Live

        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._live.start()

    def put(self, text: str) -> None:
        """Show a text in place of the last text."""
        from rich.text import Text

        self._live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)

    def close(self) -> None:
        """Remove the line."""
        self._live.stop()


class _NotebookPlace:
    def __init__(self) -> None:
        from IPython.display import display  # always present in a notebook

        self._handle: Any = display({"text/plain": ""}, raw=True, display_id=True)

    def put(self, text: str) -> None:
        self._handle.update({"text/plain": text}, raw=True)

    def close(self) -> None:
        self.put("")


def _place() -> Place | None:
    """Return a notebook or terminal display; None if stderr is not a terminal."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is not None and hasattr(shell, "kernel"):
        return _NotebookPlace()
    if sys.stderr is not None and sys.stderr.isatty():
        from rich.console import Console

        return TerminalPlace(Console(stderr=True))
    return None


@contextmanager
def shown_at(place: Place, budget: Budget) -> Iterator[Show]:
    """Provide a function that shows the state of a run, at most ten times a second.

    Parameters
    ----------
    place
        The display, which is closed at the end.
    budget
        Budget, for the remaining time.
    """
    last = -math.inf

    def show(snapshot: RunSnapshot) -> None:
        nonlocal last
        if time.monotonic() - last >= SECONDS_BETWEEN_REDRAWS:
            place.put(line_of(snapshot, budget))
            last = time.monotonic()

    try:
        place.put(STARTING)
        yield show
    finally:
        place.close()


@contextmanager
def progress_of(given: Show | bool | None, budget: Budget) -> Iterator[Show | None]:
    """Provide the display of a run started from Python, according to `progress` of `fit`.

    Parameters
    ----------
    given
        None or True for a line in a terminal or a notebook, False for no display, or a function.
    budget
        Budget, for the remaining time.

    Raises
    ------
    ProblemError
        If `given` is something else.
    """
    if callable(given):
        yield given
        return
    if given not in (None, True, False):
        raise ProblemError(
            f"progress: must be true, false or a function of a snapshot, but is {shown(given)}"
        )
    place = None if given is False else _place()
    if place is None:
        yield None
        return
    with shown_at(place, budget) as show, beating(show) as forward:
        yield forward


def line_of(snapshot: RunSnapshot, budget: Budget) -> str:
    """Return a snapshot as one line of text, with the remaining time of a budget."""
    progress, failed, number = snapshot.progress, snapshot.failures, snapshot.progress.iteration
    rate = snapshot.evaluations / max(snapshot.seconds, 1e-9)
    done = what_is_done(snapshot.search, snapshot.phase, snapshot.ended, snapshot.searches)
    parts = [
        f"{done}, iteration {number}" if number and snapshot.searches == 1 else done,
        left_of_step(snapshot.phase, snapshot.left, at_most=snapshot.at_most),
        pace_of(snapshot.pace),
        "" if snapshot.searches > 1 or math.isnan(progress.cost) else f"cost {progress.cost:.6g}",
        f"{failed} simulation{'s' if failed > 1 else ''} failed" if failed else "",
        f"{snapshot.evaluations} evaluations ({rate:.3g}/s)",
        f"{snapshot.busy}/{snapshot.workers} workers busy",
        f"{snapshot.seconds:.0f} s",
        _left_of_budget(snapshot, budget, rate),
    ]
    return " | ".join(part for part in parts if part)


def _left_of_budget(snapshot: RunSnapshot, budget: Budget, rate: float) -> str:
    """Return the remaining time of the budget; "" if the line already has the step's time."""
    if not snapshot.phase and not math.isnan(snapshot.left):
        return ""
    limits = []
    if budget.seconds is not None:
        limits.append(budget.seconds - snapshot.seconds)
    if budget.evaluations is not None and rate > 0.0:
        limits.append((budget.evaluations - snapshot.evaluations) / rate)
    return f"at most {max(0.0, min(limits)):.0f} s left" if limits else ""


LEAST_PACE = 1.0
"""Least seconds of an iteration for which the line shows the pace."""


def search_title(search: str) -> str:
    """Return the text for the user of a search, from its name in the log."""
    first, _, rest = search.partition(" ")
    if search not in SEARCH_TITLES and first in SEARCH_TITLES:
        return f"{SEARCH_TITLES[first]} {rest}"
    return SEARCH_TITLES.get(search, search)


def what_is_done(search: str, phase: str, ended: int, searches: int) -> str:
    """Return the current step of a run, and the number of ended searches in the group."""
    title = search_title(search)
    parts = [f"{phase}: {title}" if phase else title]
    if searches > 1:
        parts.append(f"{ended} of {searches} done")
    return ", ".join(parts)


def pace_of(seconds: float) -> str:
    """Return a text with the duration of an iteration; "" if it is short."""
    if not seconds >= LEAST_PACE:
        return ""
    return f"an iteration takes about {_seconds(seconds)}"


def left_of_step(phase: str, seconds: float, *, at_most: bool) -> str:
    """Return a text with the remaining time of the current step.

    If it is unknown, the text is "" outside recipes of phases. `at_most` marks an upper limit
    rather than an expected value.
    """
    if math.isnan(seconds):
        return "time left unknown" if phase else ""
    return f"this step: {'at most ' if at_most else ''}about {_seconds(seconds)} left"


def _seconds(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def note_of(callback: Callback | None) -> Note | None:
    """Return the runner's note callback from a user's callback."""
    if callback is None:
        return None
    if not callable(callback):
        raise ProblemError(f"callback: must be a function, but is {shown(callback)}")

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
