"""The line that a terminal shows while a fit runs; nothing where there is no terminal."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cluster_est.running.records import Budget, RunSnapshot

SECONDS_BETWEEN = 0.1
FIRST = (
    "the loops that call the FMU are compiled for this machine first, which takes about half a "
    "minute of one core; later runs find them ready"
)


class ProgressLine:
    """A line with cost, evaluations per second, busy workers and the time left of the budget.

    Parameters
    ----------
    console
        Where to; nothing is shown unless it is a terminal.
    budget
        What the time left is counted from.
    """

    def __init__(self, console: Console, budget: Budget) -> None:
        self._budget = budget
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._enabled = console.is_terminal
        self._shown = 0.0

    def __enter__(self) -> Self:
        if self._enabled:
            self._live.start()
            self._put("starting")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._enabled:
            self._live.stop()

    def show(self, snapshot: RunSnapshot) -> None:
        """Refresh, at most ten times a second."""
        now = time.monotonic()
        if self._enabled and now - self._shown > SECONDS_BETWEEN:
            self._shown = now
            self._put(line(snapshot, self._budget))

    def _put(self, text: str) -> None:
        self._live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)


def line(snapshot: RunSnapshot, budget: Budget) -> str:
    """The text of the line."""
    progress = snapshot.progress
    rate = snapshot.evaluations / max(snapshot.seconds, 1e-9)
    parts = [
        f"{snapshot.search}: iteration {progress.iteration}",
        "" if math.isnan(progress.cost) else f"cost {progress.cost:.6g}",
        f"{snapshot.evaluations} evaluations ({rate:.3g}/s)",
        f"{snapshot.busy}/{snapshot.workers} workers busy",
        f"{snapshot.seconds:.0f} s",
        _left(snapshot, budget, rate),
    ]
    if snapshot.failures:
        parts.insert(3, f"{snapshot.failures} simulations failed")
    return " | ".join(part for part in parts if part)


def _left(snapshot: RunSnapshot, budget: Budget, rate: float) -> str:
    """Time left of the budget: nobody knows how long a search still takes."""
    limits = []
    if budget.seconds is not None:
        limits.append(budget.seconds - snapshot.seconds)
    if budget.evaluations is not None and rate > 0.0:
        limits.append((budget.evaluations - snapshot.evaluations) / rate)
    return f"at most {max(0.0, min(limits)):.0f} s left" if limits else ""
