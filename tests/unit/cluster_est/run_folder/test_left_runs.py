"""What is said of a run whose process is gone, and of a folder that holds one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cluster_est.errors import RunFolderError
from cluster_est.report.watch import RunFollower
from cluster_est.run_folder.folder import check_free
from cluster_est.run_folder.lock import locked
from cluster_est.run_folder.reading import left_alone

GONE = "no process of this machine is at work in it any more; if it was killed, resume it with"
HOLD = """
import sys, time
from pathlib import Path
from cluster_est.run_folder.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(100)
"""


def run_of(folder: Path, status: str) -> Path:
    (folder / "evaluations").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"status": status}), encoding="utf-8")
    return folder


def test_a_run_whose_process_was_killed_is_left_alone(tmp_path):
    run = run_of(tmp_path / "run", "running")
    log = run / "evaluations"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(log)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        assert left_alone(run, "running") == ""
        os.kill(holder.pid, signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
    assert left_alone(run, "running").startswith(GONE)
    assert left_alone(run, "done") == ""


def test_who_watches_it_is_told(tmp_path):
    run = run_of(tmp_path / "run", "running")
    with locked(run / "evaluations"):
        pass
    clock = iter([0.0, 0.0, 1.0, 1.0, 10.0, 10.0])
    follower = RunFollower(run, lambda: next(clock))
    assert follower.look().message == ""
    assert follower.look().message.startswith(GONE)


def test_a_run_without_a_lock_may_be_anywhere(tmp_path):
    assert left_alone(run_of(tmp_path / "run", "running"), "running") == ""


@pytest.mark.parametrize("status", ["running", "interrupted"])
def test_the_refusal_of_a_run_that_can_be_taken_up_names_that_first(tmp_path, status):
    with pytest.raises(RunFolderError) as error:
        check_free(run_of(tmp_path / "run", status), overwrite=False)
    assert str(error.value).endswith(
        "run: holds a run already; take it up where it ended with --resume, choose another --out, "
        "or replace it with --overwrite"
    )


def test_one_that_is_done_is_not_to_be_taken_up(tmp_path):
    with pytest.raises(RunFolderError) as error:
        check_free(run_of(tmp_path / "run", "done"), overwrite=False)
    assert "--resume" not in str(error.value)
