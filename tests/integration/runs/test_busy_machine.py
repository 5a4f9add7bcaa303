"""A machine that is busy with other things changes no failure, no evaluation and no bit.

Workers that are stopped most of the time stand for the load: a clock that decided anything would
show.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import spring_problem
from support.stopping import stopped_now_and_then
from support.truth.springs_with_friction import write_config

import cluster_est as ce
from cluster_est.config.settings import build_settings
from workers.messages import Limits, Outcome

pytestmark = pytest.mark.slow

WORKERS = 2
IMPATIENT = Limits(stall=2.0)
"""Far less than the time that a stopped process stands still in all."""


class Recorder:
    """Every simulation of a run, in no order."""

    def __init__(self) -> None:
        self.rows: list[tuple[object, ...]] = []

    def __call__(self, origin: object, outcome: Outcome) -> None:
        found = b"" if outcome.residuals is None else outcome.residuals.tobytes()
        values = origin.task.values.tobytes()  # type: ignore[attr-defined]
        self.rows.append((origin.search, origin.task.experiment, values, outcome.status, found))  # type: ignore[attr-defined]


def twice(run: Callable[[Recorder], object]) -> list[object]:
    """A run on an idle machine and on a busy one, each with what it has simulated."""
    idle, busy = Recorder(), Recorder()
    first = run(idle)
    with stopped_now_and_then() as processes:
        second = run(busy)
    assert sorted(map(repr, idle.rows)) == sorted(map(repr, busy.rows))
    assert 0 < len(processes) <= 2 * WORKERS + 2  # none was taken for hung and replaced
    return [first, second]


def test_a_fit_is_the_same() -> None:
    problem = spring_problem(experiments=3, samples=60, noise=0.01).problem
    resources = ce.Resources("processes", WORKERS, limits=IMPATIENT)

    def run(recorder: Recorder) -> ce.Result:
        return ce.fit(problem, ce.LeastSquares(differences="auto"), resources, record=recorder)

    idle, busy = twice(run)
    assert (idle.evaluations, idle.failures) == (busy.evaluations, busy.failures)
    assert idle.x == busy.x
    assert idle.solution.x.tobytes() == busy.solution.x.tobytes()
    for name in idle.tables:
        assert repr(idle.table(name).to_pylist()) == repr(busy.table(name).to_pylist())


def test_a_closed_loop_is_the_same(tmp_path: Path) -> None:
    config = ce.read_config(write_config(tmp_path))
    problem, settings = ce.build_problem(config, tmp_path), build_settings(config)
    resources = ce.Resources("processes", WORKERS, limits=IMPATIENT)

    def run(recorder: Recorder) -> ce.LoopResult:
        return ce.close_loop(problem, resources, settings, record=recorder)

    idle, busy = twice(run)
    assert (idle.evaluations, idle.failures) == (busy.evaluations, busy.failures)
    assert (idle.verdict, idle.summary) == (busy.verdict, busy.summary)
    for name in idle.tables:
        assert repr(idle.table(name).to_pylist()) == repr(busy.table(name).to_pylist())
    assert np.isfinite(idle.after.cost)
