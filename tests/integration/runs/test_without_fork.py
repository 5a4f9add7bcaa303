"""The program without what Windows lacks, and without modules that a fit has no use for.

Nothing ends in a traceback where `os.fork`, `signal.pthread_kill` and `signal.SIGKILL` are deleted
before anything is imported.
"""

import json
import subprocess
import sys

import pytest
from support.run_folders import SPRING

from cluster_est.run_folder.run_files import read_run_table

PROGRAM = """
import contextlib, io, json, os, signal, sys
del os.fork, signal.pthread_kill, signal.SIGKILL
from cluster_est.cli import main
ends = []
for command in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(command)
    ends.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(ends))
"""


def ends_of(commands: list[list[str]]) -> list[tuple[int, str, str]]:
    """The exit code, the output and the errors of commands on a system without these."""
    program = [sys.executable, "-c", PROGRAM, json.dumps(commands)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ends = json.loads(done.stdout.splitlines()[-1])
    assert not any("Traceback" in out + err for _, out, err in ends)
    return ends


def test_a_fit_and_a_check_work_in_this_process_and_a_replay_says_what_it_lacks(tmp_path):
    broken, run = tmp_path / "broken.fmu", tmp_path / "run"
    broken.write_bytes(b"no archive")
    fitted, checked, unloaded, replayed = ends_of(
        [
            ["fit", SPRING, "--out", str(run), "executor.workers=2"],
            ["check", SPRING],
            ["check", str(broken)],
            ["replay", str(run), "0"],
        ]
    )
    assert fitted[0] == 0, fitted[2]
    assert (run / "report.html").is_file()
    code, out, _ = checked
    assert code == 0, out
    assert "two simulations in fresh instances are identical bit for bit" in out
    assert "no problem was found" in out
    assert '"processes"' not in out  # would be advice that cannot be followed
    assert unloaded[0] != 0
    assert "broken.fmu" in unloaded[1] + unloaded[2]
    assert replayed[0] == 2
    assert "needs a system that can fork processes" in replayed[2]


@pytest.mark.parametrize(
    "commands", [["fit"], pytest.param(["close-loop", "sensitivity"], marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_processes_are_refused_in_a_sentence(tmp_path, commands):
    chosen = "--out", str(tmp_path / "run"), "executor.name=processes"
    for code, _, err in ends_of([[command, SPRING, *chosen] for command in commands]):
        assert code == 2
        assert err.startswith('cluster-est: executor.name: "processes" needs a system that can')
        assert err.endswith('choose "local"\n')
    assert not (tmp_path / "run").exists()


SLOW_TO_LOAD = (
    *("sympy", "scipy.signal", "scipy.stats", "scipy.integrate"),
    *("pyarrow.dataset", "ray"),
)
FIT = """
import sys
from cluster_est.cli import main

code = main(["fit", sys.argv[1], "--out", sys.argv[2]])
print("loaded:", *(name for name in sys.argv[3:] if name in sys.modules))
sys.exit(code)
"""


def test_a_fit_with_its_report_loads_nothing_that_is_slow_to_load_and_not_needed(tmp_path):
    """Readers of partitioned data would make a column of a folder that is named k=3."""
    run = tmp_path / "k=3"
    asked = [sys.executable, "-c", FIT, SPRING, str(run), *SLOW_TO_LOAD]
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (run / "report.html").is_file()
    assert done.stdout.splitlines()[-1] == "loaded:"
    rows = read_run_table(run / "errors.parquet")
    assert len(rows) == 5
    assert "k" not in rows[0]
