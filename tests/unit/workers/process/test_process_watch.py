"""What stands still is told from what waits for its turn. Times and states are made up."""

import os
import subprocess
import sys

import pytest

from workers.messages.types import CALLED, RUNNING, SIMULATIONS, no_watcher
from workers.process import progress_watch
from workers.process.progress_watch import (
    ProcessActivity,
    ProgressWatch,
    SharedProgress,
    map_progress,
)


@pytest.fixture
def progress():
    return no_watcher()


@pytest.fixture
def let_pass(monkeypatch):
    """Let seconds pass, after which the system says something of the process."""
    now = [100.0, ProcessActivity(waiting=True, seconds=5.0)]
    monkeypatch.setattr(progress_watch.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(ProcessActivity, "of", staticmethod(lambda process: now[1]))

    def then(seconds: float, activity: ProcessActivity | None) -> None:
        now[0] += seconds
        now[1] = activity

    return then


@pytest.mark.parametrize(
    ("seconds", "waiting", "active", "still"),
    [
        (3600.0, True, [5.2, 5.4, 5.6], 0.6),  # a busy machine gives it 0.2 s in an hour
        (10.0, True, [14.0], 9.0),
        (0.5, False, [5.0] * 20, 10.0),
        (3600.0, False, [5.0], progress_watch.LATE_SECONDS),
    ],
    ids=["ready but not let run", "busy without a step", "asleep", "who looks was asleep itself"],
)
def test_for_how_long_it_stands_still(progress, let_pass, seconds, waiting, active, still):
    seen = ProgressWatch(1, progress)
    for so_far in active:
        let_pass(seconds, ProcessActivity(waiting=waiting, seconds=so_far))
        seen.look()
    assert seen.still == pytest.approx(still, rel=1e-12)


@pytest.mark.parametrize("which", [CALLED, SIMULATIONS])
def test_a_step_begins_it_anew(progress, let_pass, which):
    seen = ProgressWatch(1, progress)
    let_pass(10.0, ProcessActivity(waiting=True, seconds=14.0))
    seen.look()
    progress[which] += 1
    seen.look()
    assert seen.still == 0.0
    let_pass(10.0, ProcessActivity(waiting=True, seconds=20.0))
    seen.look()
    assert seen.still == pytest.approx(6.0)


def test_each_simulation_has_the_time_for_itself(progress, let_pass):
    seen = ProgressWatch(1, progress)
    progress[:] = 1, 1, 1, 0
    for _ in range(4):
        let_pass(2.0, None)
        progress[SIMULATIONS] += 1
        seen.look()
    for _ in range(6):
        let_pass(0.5, None)
        seen.look()
    assert seen.simulated == pytest.approx(3.0)
    let_pass(3600.0, None)  # the whole machine was suspended
    seen.look()
    assert seen.simulated == pytest.approx(4.0)
    progress[RUNNING] = 0
    assert seen.simulated == 0.0


def test_progress_is_seen_by_another_process():
    shared = SharedProgress()
    code = (
        "import sys; from workers.process.progress_watch import map_progress; "
        "map_progress(int(sys.argv[1]))[:] = 7, 8, 9, 10"
    )
    command = [sys.executable, "-c", code, str(shared.descriptor)]
    subprocess.run(command, pass_fds=[shared.descriptor], check=True)
    assert shared.progress.tolist() == [7, 8, 9, 10]
    assert map_progress(shared.descriptor).tolist() == [7, 8, 9, 10]
    shared.close()
    shared.close()


def test_the_system_says_something_of_this_process():
    found = ProcessActivity.of(os.getpid())
    assert found is not None
    assert found.seconds > 0.0
    assert ProcessActivity.of(2**22 + 1) is None
