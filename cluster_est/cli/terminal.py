"""The terminal as the listener of a run."""

from __future__ import annotations

import math
import os
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.run_folder.context import ExistingRun
from cluster_est.run_folder.run_files import RunStatus
from cluster_est.run_folder.run_progress import left_of_step, pace_of, what_is_done
from cluster_est.running.heartbeat import beating
from cluster_est.running.resources import Budget, Resources, RunSnapshot, Show
from cluster_est.studies.configured import ConfiguredStudy, Destination, Listener, RunEnd, do_run
from workers.core.build import built, is_built

SECONDS_BETWEEN_REDRAWS = 0.1
SECONDS_OF_LINES, SHARE_OF_LINES = 30.0, 0.05
"""Least time between two printed lines: seconds, and share of the time that the run has taken."""
HINT_SECONDS = 20.0
"""Seconds in which all workers were busy and as many simulations again were waiting."""

BUILDS_CORE = (
    "compiling the simulation core, once on this machine; this takes about 10 s, or longer if "
    "other programs keep the processor busy"
)

EXIT_CODES = {
    RunStatus.DONE: ExitCode.DONE,
    RunStatus.NOT_CONVERGED: ExitCode.NO_SOLUTION,
    RunStatus.FAILED: ExitCode.NO_SOLUTION,
    RunStatus.INTERRUPTED: ExitCode.INTERRUPTED,
}


class ProgressLine:
    """A line with what is done, the time left, evaluations per second and busy workers.

    On a terminal it is renewed in place; elsewhere it is printed once in a while, less and less
    often. Where more workers would help, a sentence says so once.

    Parameters
    ----------
    console
        Where to.
    budget
        What the time left is counted from.
    cores
        Of this machine.
    clock
        Gives seconds; for tests.
    most_workers
        That can be started; None for any number.
    """

    def __init__(
        self,
        console: Console,
        budget: Budget,
        cores: int | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        most_workers: int | None = None,
    ) -> None:
        self._budget, self._console, self._clock = budget, console, clock
        self._begun = self._printed = clock()
        self._hint = WorkerHint(os.cpu_count() or 1 if cores is None else cores, most_workers)
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._enabled = console.is_terminal
        self._shown = 0.0

    def __enter__(self) -> Self:
        if self._enabled:
            self._live.start()
            self._put("starting")
        return self

    def __exit__(self, *_: object) -> None:
        if self._enabled:
            self._live.stop()

    def show(self, snapshot: RunSnapshot) -> None:
        """Refresh, at most ten times a second."""
        now = self._clock()
        if now - self._shown <= SECONDS_BETWEEN_REDRAWS:
            return
        self._shown = now
        if hint := self._hint.look(snapshot):
            self._print(hint)
        if self._enabled:
            self._put(line(snapshot, self._budget))
        elif now - self._printed >= max(SECONDS_OF_LINES, SHARE_OF_LINES * (now - self._begun)):
            self._printed = now
            self._print(line(snapshot, self._budget))

    def _print(self, text: str) -> None:
        self._console.print(f"cluster-est: {text}", soft_wrap=True, highlight=False, markup=False)

    def _put(self, text: str) -> None:
        self._live.update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)


class WorkerHint:
    """Says once that more workers would help: all are busy, and cores of this machine are not.

    Parameters
    ----------
    cores
        Of this machine.
    most_workers
        That can be started; None for any number.
    """

    def __init__(self, cores: int, most_workers: int | None = None) -> None:
        self._cores = cores
        self._useful = cores if most_workers is None else min(cores, most_workers)
        self._since = math.nan
        self._said = False

    def look(self, snapshot: RunSnapshot) -> str:
        """Return the sentence where it is due, else nothing."""
        workers = snapshot.workers
        if self._said or workers >= self._useful:
            return ""
        if snapshot.busy < workers or snapshot.waiting < workers:
            self._since = math.nan
            return ""
        if math.isnan(self._since):
            self._since = snapshot.seconds
        if snapshot.seconds - self._since < HINT_SECONDS:
            return ""
        self._said = True
        verb = "simulates" if workers == 1 else "simulate"
        return (
            f"{workers} of this machine's {self._cores} cores {verb} while {snapshot.waiting} "
            f"simulations wait; executor.workers={self._useful} would be faster, and the result "
            "the same (stop with Ctrl-C, continue with --resume)"
        )


def line(snapshot: RunSnapshot, budget: Budget) -> str:
    """The text of the line."""
    progress = snapshot.progress
    rate = snapshot.evaluations / max(snapshot.seconds, 1e-9)
    done = what_is_done(snapshot.search, snapshot.phase, snapshot.ended, snapshot.searches)
    parts = [
        f"{done}, iteration {progress.iteration}" if snapshot.searches == 1 else done,
        left_of_step(snapshot.phase, snapshot.left, at_most=snapshot.at_most),
        pace_of(snapshot.pace),
        "" if snapshot.searches > 1 or math.isnan(progress.cost) else f"cost {progress.cost:.6g}",
        f"{snapshot.evaluations} evaluations ({rate:.3g}/s)",
        f"{snapshot.busy}/{snapshot.workers} workers busy",
        f"{snapshot.seconds:.0f} s",
        _left(snapshot, budget, rate),
    ]
    if snapshot.failures:
        parts.insert(4, f"{snapshot.failures} simulations failed")
    return " | ".join(part for part in parts if part)


def _left(snapshot: RunSnapshot, budget: Budget, rate: float) -> str:
    """Time left of the budget of a recipe of many steps; that of a single one is said already."""
    if not snapshot.phase and not math.isnan(snapshot.left):
        return ""
    limits = []
    if budget.seconds is not None:
        limits.append(budget.seconds - snapshot.seconds)
    if budget.evaluations is not None and rate > 0.0:
        limits.append((budget.evaluations - snapshot.evaluations) / rate)
    return f"at most {max(0.0, min(limits)):.0f} s left" if limits else ""


def build_core(answer: Answer) -> None:
    """Build the simulation core where this machine has none yet, once for all workers.

    Raises
    ------
    ModelError
        If it cannot be built.
    """
    if not is_built():
        answer.complain(BUILDS_CORE)
        with alive("compiling the simulation core"):
            built()


def run_as_told(run: ConfiguredStudy, out: Path, options: Namespace, answer: Answer) -> RunEnd:
    """Do a run as the arguments of its command say, and complain where it has no result."""
    existing = ExistingRun.OVERWRITE if options.overwrite else ExistingRun.REFUSE
    existing = ExistingRun.RESUME if options.resume else existing
    to = Destination(out, existing, report=not options.no_report)
    with _page(out, options):
        end = do_run(run, to, terminal_listener(answer))
    if end.stopped:
        answer.complain(end.stopped)
    return end


def _page(out: Path, options: Namespace) -> AbstractContextManager[None]:
    """Give the page in a browser, where one is asked for."""
    if not options.browser:
        return nullcontext()
    from cluster_est.cli.live_page import page_beside  # not everybody wants to wait for a server

    return page_beside(out, allow_code=options.allow_code)


def say_report(answer: Answer, run_folder: Path) -> None:
    """Say where the report of a run stands, if it has one."""
    if (run_folder / "report.html").is_file():
        answer.say(f"report: {run_folder / 'report.html'}")


def terminal_listener(answer: Answer) -> Listener:
    """Make a listener that prints to standard error, and shows a line while a run goes on."""
    return Listener(answer.complain, _progress, alive)


@contextmanager
def alive(doing: str) -> Iterator[None]:
    """Show on a terminal what is done before or after a run, and for how many seconds."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(snapshot: RunSnapshot) -> None:
            live.update(Text(f"{doing}, {snapshot.seconds:.0f} s", no_wrap=True), refresh=True)

        with beating(show):
            yield


@contextmanager
def _progress(resources: Resources) -> Iterator[Show]:
    console, most = Console(stderr=True), resources.instances
    with ProgressLine(console, resources.budget, most_workers=most) as line:
        yield line.show
