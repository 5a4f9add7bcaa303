"""A machine that is busy with other things changes no failure, no evaluation and no bit.

Workers that are stopped most of the time stand for the load: a clock that decided anything would
show.
"""

from pathlib import Path

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


def fitted(_: Path, resources: ce.Resources, record: Recorder) -> ce.Result:
    problem = spring_problem(experiments=3, samples=60, noise=0.01).problem
    return ce.fit(problem, ce.LeastSquares(differences="auto"), resources, record=record)


def closed(folder: Path, resources: ce.Resources, record: Recorder) -> ce.LoopResult:
    config = ce.read_config(write_config(folder))
    problem, settings = ce.build_problem(config, folder), build_settings(config)
    return ce.close_loop(problem, resources, settings, record=record)


@pytest.mark.parametrize("run", [fitted, closed])
def test_a_run_is_the_same_on_an_idle_machine_and_on_a_busy_one(run, tmp_path: Path) -> None:
    first, second = Recorder(), Recorder()
    resources = ce.Resources("processes", WORKERS, limits=IMPATIENT)
    idle = run(tmp_path, resources, first)
    with stopped_now_and_then() as processes:
        busy = run(tmp_path, resources, second)
    assert sorted(map(repr, first.rows)) == sorted(map(repr, second.rows))
    assert 0 < len(processes) <= 2 * WORKERS + 2  # none was taken for hung and replaced
    assert (idle.evaluations, idle.failures) == (busy.evaluations, busy.failures)
    assert str(idle) == str(busy)
    for name in idle.tables:
        assert repr(idle.table(name).to_pylist()) == repr(busy.table(name).to_pylist())
