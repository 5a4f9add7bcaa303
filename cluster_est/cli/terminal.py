"""Output of a run in the terminal."""

from __future__ import annotations

import math
import os
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from pathlib import Path

from rich.console import Console

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.run_folder.context import ExistingRun
from cluster_est.run_folder.run_files import RunStatus
from cluster_est.running.heartbeat import beating
from cluster_est.running.progress_line import TerminalPlace, shown_at
from cluster_est.running.resources import Resources, RunSnapshot, Show
from cluster_est.studies.configured import ConfiguredStudy, Destination, Listener, RunEnd, do_run
from workers.core.build import built, is_built

SECONDS_OF_LINES, SHARE_OF_LINES = 30.0, 0.05
"""Shortest time between two printed lines: seconds, and share of the duration of the run."""
HINT_SECONDS = 20.0
"""Seconds in which all workers were busy and as many other simulations were waiting."""

BUILDS_CORE = (
    "compiling the simulation core, which is needed only once on this machine; this takes about 10 "
    "s, or longer if other programs use the processor"
)

EXIT_CODES = {
    RunStatus.DONE: ExitCode.DONE,
    RunStatus.NOT_CONVERGED: ExitCode.NO_SOLUTION,
    RunStatus.FAILED: ExitCode.NO_SOLUTION,
    RunStatus.INTERRUPTED: ExitCode.INTERRUPTED,
}


class PrintedPlace:
    """Prints lines at increasing intervals, for standard error in a file.

    Parameters
    ----------
    console
        The console.
    clock
        Returns seconds; for tests.
    """

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._clock = console, clock
        self._begun = self._printed = clock()

    def put(self, text: str) -> None:
        """Print a text if the interval has passed."""
        now = self._clock()
        if now - self._printed >= max(SECONDS_OF_LINES, SHARE_OF_LINES * (now - self._begun)):
            self._printed = now
            _print(self._console, text)

    def close(self) -> None:
        """Keep the printed lines."""


def _print(console: Console, text: str) -> None:
    console.print(f"cluster-est: {text}", soft_wrap=True, highlight=False, markup=False)


class WorkerHint:
    """Recommends more workers once if all are busy, but not all cores of this machine.

    Parameters
    ----------
    cores
        Number of cores of this machine.
    most_workers
        Largest number of workers that can be started; None for no limit.
    """

    def __init__(self, cores: int, most_workers: int | None = None) -> None:
        self._cores = cores
        self._useful = cores if most_workers is None else min(cores, most_workers)
        self._since = math.nan
        self._said = False

    def look(self, snapshot: RunSnapshot) -> str:
        """Return the recommendation when it is due, otherwise ""."""
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
            f"{workers} of this machine's {self._cores} cores {verb}, while {snapshot.waiting} "
            f"simulations wait. The run would be faster with executor.workers={self._useful}, and "
            "its result the same: stop it with Ctrl-C, and continue with --resume"
        )


def build_core(answer: Answer) -> None:
    """Compile the simulation core if it is missing, once for all workers.

    Raises
    ------
    ModelError
        If it cannot be compiled.
    """
    if not is_built():
        answer.complain(BUILDS_CORE)
        with alive("compiling the simulation core"):
            built()


def run_as_told(run: ConfiguredStudy, out: Path, options: Namespace, answer: Answer) -> RunEnd:
    """Perform a run with the arguments of its command, and complain if it has no result."""
    existing = ExistingRun.OVERWRITE if options.overwrite else ExistingRun.REFUSE
    existing = ExistingRun.RESUME if options.resume else existing
    to = Destination(out, existing, report=not options.no_report)
    with _page(out, options):
        end = do_run(run, to, terminal_listener(answer))
    if end.stopped:
        answer.complain(end.stopped)
    return end


def _page(out: Path, options: Namespace) -> AbstractContextManager[None]:
    """Return a context that serves the page in a browser, if requested."""
    if not options.browser:
        return nullcontext()
    from cluster_est.cli.live_page import page_beside  # the server is imported only if needed

    return page_beside(out, allow_code=options.allow_code)


def say_report(answer: Answer, run_folder: Path) -> None:
    """Print the path of the report of a run, if it has one."""
    if (run_folder / "report.html").is_file():
        answer.say(f"report: {run_folder / 'report.html'}")


def terminal_listener(answer: Answer) -> Listener:
    """Return a listener that prints to standard error, and shows a progress line during a run."""
    return Listener(answer.complain, _progress, alive)


@contextmanager
def alive(doing: str) -> Iterator[None]:
    """Show an activity before or after a run on a terminal, with its duration."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with (
        closing(TerminalPlace(console)) as place,
        beating(lambda snapshot: place.put(f"{doing}, {snapshot.seconds:.0f} s")),
    ):
        yield


@contextmanager
def _progress(resources: Resources) -> Iterator[Show]:
    """Yield a function that shows the progress of a run, and once recommends more workers."""
    console = Console(stderr=True)
    place = TerminalPlace(console) if console.is_terminal else PrintedPlace(console)
    hint = WorkerHint(os.cpu_count() or 1, resources.instances)
    with shown_at(place, resources.budget) as show:

        def look(snapshot: RunSnapshot) -> None:
            if said := hint.look(snapshot):
                _print(console, said)
            show(snapshot)

        yield look
