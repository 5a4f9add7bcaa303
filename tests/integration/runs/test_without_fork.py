"""Without what Windows lacks nothing ends in a traceback.

`os.fork`, `signal.pthread_kill` and `signal.SIGKILL` are deleted before anything is imported.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support.run_folders import SPRING

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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("without_fork")


@pytest.fixture(scope="module")
def told(folder: Path) -> dict[str, tuple[int, str, str]]:
    """The ends of several commands."""
    (folder / "broken.fmu").write_bytes(b"no archive")
    run = str(folder / "run")
    commands = {
        "fit": ["fit", SPRING, "--out", run, "executor.workers=2"],
        "check": ["check", SPRING],
        "check broken": ["check", str(folder / "broken.fmu")],
        "replay": ["replay", run, "0"],
    }
    return dict(zip(commands, ends_of([*commands.values()]), strict=True))


def test_a_fit_in_this_process_works(told, folder) -> None:
    code, _, err = told["fit"]
    assert code == 0, err
    assert (folder / "run" / "report.html").is_file()


def test_check_examines_the_fmu_in_this_process(told) -> None:
    code, out, _ = told["check"]
    assert code == 0, out
    assert "two fresh instances give the same bits" in out
    assert "no problem was found" in out
    assert '"processes"' not in out  # would be advice that cannot be followed


def test_check_says_in_a_sentence_what_cannot_be_loaded(told) -> None:
    code, out, err = told["check broken"]
    assert code != 0
    assert "broken.fmu" in out + err


@pytest.mark.parametrize(
    "commands", [["fit"], pytest.param(["close-loop", "sensitivity"], marks=pytest.mark.slow)]
)
def test_processes_are_refused_in_a_sentence(tmp_path, commands: list[str]) -> None:
    chosen = "--out", str(tmp_path / "run"), "executor.name=processes"
    for code, _, err in ends_of([[command, SPRING, *chosen] for command in commands]):
        assert code == 2
        assert err.startswith('cluster-est: executor.name: "processes" needs a system that can')
        assert err.endswith('choose "local"\n')
    assert not (tmp_path / "run").exists()


def test_a_replay_says_what_it_lacks(told) -> None:
    code, _, err = told["replay"]
    assert code == 2
    assert "needs a system that can fork processes" in err
