"""A machine that is busy with other things changes no failure, no evaluation and no bit.

Workers that are stopped most of the time stand for the load: a clock that decided anything would
show.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.descendants import descendants
from support.problems.springs import spring_problem
from support.truth.springs_with_friction import write_config

import cluster_est as ce
from workers.messages import Limits

pytestmark = pytest.mark.slow

WORKERS = 2
IMPATIENT = Limits(stall=2.0)
"""Far less than the time that a stopped process stands still in all."""
STOPPED, RUNNING = 0.3, 0.1
"""Seconds of each."""


@contextlib.contextmanager
def stopped_now_and_then() -> Iterator[set[int]]:
    """Stop every process that is there for an FMU, and let it go on, over and over.

    Gives the ids of all that there were. Each stands still for three times as long as it runs in
    between.
    """
    seen: set[int] = set()
    ended = threading.Event()

    def send(number: int) -> None:
        for process in seen:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)

    def go_on() -> None:
        while not ended.is_set():
            seen.update(descendants(3))
            send(signal.SIGSTOP)
            ended.wait(STOPPED)
            send(signal.SIGCONT)
            ended.wait(RUNNING)

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield seen
    finally:
        ended.set()
        thread.join()


class Recorder:
    """Every simulation of a run, in no order."""

    def __init__(self):
        self.rows = []

    def __call__(self, origin, outcome):
        found = b"" if outcome.residuals is None else outcome.residuals.tobytes()
        task = origin.task
        row = origin.search, task.experiment, task.values.tobytes(), outcome.status, found
        self.rows.append(repr(row))


def fitted(_: Path, resources: ce.Resources, record: Recorder) -> ce.Result:
    problem = spring_problem(experiments=3, samples=60, noise=0.01).problem
    method = ce.LeastSquares(differences="auto")
    return ce.fit(problem, method, resources, record=record, multistart=ce.Multistart(20))


def closed(folder: Path, resources: ce.Resources, record: Recorder) -> ce.LoopResult:
    config = ce.read_config(write_config(folder))
    problem, settings = ce.build_problem(config, folder), config.closed_loop
    return ce.close_loop(problem, resources, settings, record=record)


@pytest.mark.parametrize("run", [fitted, closed])
def test_a_run_is_the_same_on_an_idle_machine_and_on_a_busy_one(run, tmp_path: Path) -> None:
    first, second = Recorder(), Recorder()
    resources = ce.Resources("processes", WORKERS, limits=IMPATIENT)
    idle = run(tmp_path, resources, first)
    with stopped_now_and_then() as processes:
        busy = run(tmp_path, resources, second)
    assert sorted(first.rows) == sorted(second.rows)
    assert 0 < len(processes) <= 2 * WORKERS + 2  # none was taken for hung and replaced
    assert (idle.evaluations, idle.failures) == (busy.evaluations, busy.failures)
    assert str(idle) == str(busy)
    for name in idle.tables:
        assert repr(idle.table(name).to_pylist()) == repr(busy.table(name).to_pylist())
