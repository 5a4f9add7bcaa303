"""The terminal as the listener of a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from cluster_est.cli.display.progress import FIRST, ProgressLine
from cluster_est.cli.display.run import say
from cluster_est.configured_run import Listener
from cluster_est.problem.effects.process_noise import noise_names
from cluster_est.problem.problem import Problem
from cluster_est.running.records import Show
from cluster_est.running.resources import Resources
from workers.kernels.fmi.compiling import compiled_before


def complain(text: str) -> None:
    """Print a sentence beside the output, with the program's name."""
    say(Console(stderr=True), f"cluster-est: {text}")


def say_if_compiled_first() -> None:
    """Say what there is to wait for, where the loops have never been compiled."""
    if not compiled_before():
        complain(FIRST)


def say_if_filter_compiled_first(problem: Problem) -> None:
    """The same of the filter that process noise needs, which is compiled when it is first used."""
    if noise_names(problem) and not compiled_before("kalman"):
        complain(
            "process noise: its filter is compiled with the first simulation, once on a machine; "
            "that takes a quarter of a minute to a minute"
        )


def terminal_listener() -> Listener:
    """Make a listener that prints to standard error, and shows a line while a run goes on."""
    return Listener(complain, _progress)


@contextmanager
def _progress(resources: Resources) -> Iterator[Show]:
    console, most = Console(stderr=True), resources.instances
    with ProgressLine(console, resources.budget, most_workers=most) as line:
        yield line.show
