import errno
import json
import os
import signal
import socket
import subprocess
import sys

import pytest
from filelock import UnixFileLock

from cluster_est.errors import RunFolderError
from cluster_est.run_folder.lock import LOCK, SWEEP_OWNER, RunLock, lock, locked_by_sweep
from cluster_est.run_folder.run_files import left_alone
from cluster_est.run_folder.run_folder import check_free
from cluster_est.watching.follower import RunFollower

GONE = (
    "no process on this machine works in the run folder any more; if the run was killed, continue "
    "it with"
)
HOLD = """
import sys, time
from pathlib import Path
from cluster_est.run_folder.lock import RunLock, locked_by_sweep
with {function}(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
COUNT = """
import sys
from pathlib import Path
from cluster_est.errors import RunFolderError
from cluster_est.run_folder.lock import locked_by_sweep
folder = Path(sys.argv[1])
done = 0
while done < 20:
    try:
        with locked_by_sweep(folder / "out"):
            (folder / "inside").touch(exist_ok=False)
            (folder / "inside").unlink()
            done += 1
    except RunFolderError:
        pass
"""


def start(code, folder):
    return subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True
    )


def kill_holder(function, folder):
    """The number of a process that was killed while it had the lock."""
    with start(HOLD.format(function=function), folder) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(RunFolderError, match="running here"):
            lock(folder, LOCK if function == "RunLock" else ".sweep.flock")
        os.kill(holder.pid, signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
    return holder.pid


def write_owner(folder, text):
    (folder / SWEEP_OWNER).write_text(text, encoding="utf-8")


@pytest.fixture
def without_locks(monkeypatch):
    """A drive that has no locks."""

    def refuse(self):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(UnixFileLock, "_acquire", refuse)


def test_a_lock_keeps_others_out_until_it_is_released(tmp_path):
    with (
        RunLock(tmp_path),
        pytest.raises(RunFolderError, match=r"running here .process .*; wait for it, or end"),
    ):
        lock(tmp_path)
    with RunLock(tmp_path):
        pass


def test_a_folder_without_locks_is_used_without(tmp_path, without_locks):
    assert lock(tmp_path) is None
    with RunLock(tmp_path), RunLock(tmp_path):
        pass


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="who may write everywhere")
def test_a_folder_that_cannot_be_written_is_read_without(tmp_path):
    tmp_path.chmod(0o500)
    assert lock(tmp_path) is None
    with pytest.raises(RunFolderError, match="cannot be written"), locked_by_sweep(tmp_path):
        pass
    tmp_path.chmod(0o700)


def test_a_sweep_says_who_it_is_and_leaves_no_name(tmp_path):
    with locked_by_sweep(tmp_path):
        owner = json.loads((tmp_path / SWEEP_OWNER).read_text())
        assert owner == {"pid": os.getpid(), "host": socket.gethostname()}
        who = f"another sweep is running here .process {os.getpid()} on .*; wait for it, or end it"
        with pytest.raises(RunFolderError, match=who), locked_by_sweep(tmp_path):
            pass
        assert (tmp_path / SWEEP_OWNER).is_file()
    assert not (tmp_path / SWEEP_OWNER).exists()


def test_the_name_of_a_killed_sweep_is_replaced(tmp_path):
    pid = kill_holder("locked_by_sweep", tmp_path)
    assert json.loads((tmp_path / SWEEP_OWNER).read_text())["pid"] == pid
    with locked_by_sweep(tmp_path):
        assert json.loads((tmp_path / SWEEP_OWNER).read_text())["pid"] == os.getpid()


@pytest.mark.parametrize("text", ['{"pid": 7, "host": "elsewhere"}', "{", "[]", ""])
def test_a_sweep_that_may_still_be_at_work_elsewhere_is_left_alone(tmp_path, text):
    write_owner(tmp_path, text)
    with pytest.raises(RunFolderError, match=r"remove .*\.sweep\.lock"), locked_by_sweep(tmp_path):
        pass
    assert (tmp_path / SWEEP_OWNER).read_text() == text


def test_without_locks_a_name_of_this_machine_counts_too(tmp_path, without_locks):
    with locked_by_sweep(tmp_path):
        taken = pytest.raises(RunFolderError, match=r"remove .*\.sweep\.lock")
        with taken, locked_by_sweep(tmp_path):
            pass
        assert (tmp_path / SWEEP_OWNER).is_file()
    with locked_by_sweep(tmp_path):
        pass


def test_of_many_that_take_over_only_one_is_inside(tmp_path):
    (tmp_path / "out").mkdir()
    write_owner(tmp_path / "out", json.dumps({"pid": 7, "host": socket.gethostname()}))
    racing = [start(COUNT, tmp_path) for _ in range(3)]
    for each in racing:
        each.communicate()
    assert [each.returncode for each in racing] == [0, 0, 0]


def run_of(folder, status):
    (folder / "evaluations").mkdir()
    (folder / "run.json").write_text(json.dumps({"status": status}), encoding="utf-8")
    return folder


def test_a_run_whose_process_was_killed_is_left_alone_and_who_watches_it_is_told(tmp_path):
    run = run_of(tmp_path, "running")
    assert left_alone(run, "running") == "", "without a lock it may be anywhere"
    with RunLock(run / "evaluations"):
        assert left_alone(run, "running") == ""
    kill_holder("RunLock", run / "evaluations")
    assert left_alone(run, "running").startswith(GONE)
    assert left_alone(run, "done") == ""
    clock = iter([0.0, 0.0, 1.0, 1.0, 10.0, 10.0])
    follower = RunFollower(run, lambda: next(clock))
    assert follower.look().message == ""
    assert follower.look().message.startswith(GONE)


@pytest.mark.parametrize("status", ["running", "interrupted", "done"])
def test_the_refusal_of_a_run_that_can_be_taken_up_names_that_first(tmp_path, status):
    with pytest.raises(RunFolderError, match=r"holds a run already.*--out.*--overwrite") as error:
        check_free(run_of(tmp_path, status), overwrite=False)
    assert ("already; continue the run with --resume" in str(error.value)) == (status != "done")
