"""Without what Windows lacks nothing ends in a traceback.

`os.fork`, `signal.pthread_kill` and `signal.SIGKILL` are deleted before anything is imported.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from support.problems.springs import ROOT

CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
PROGRAM = """
import os, signal
del os.fork, signal.pthread_kill, signal.SIGKILL
from cluster_est.cli import run
run()
"""


def told(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command on a system without these."""
    command = [sys.executable, "-c", PROGRAM, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_fit_in_this_process_works(tmp_path: Path) -> None:
    run = told("fit", str(CONFIG), "--out", str(tmp_path / "run"), "executor.workers=2")
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    assert (tmp_path / "run" / "report.html").is_file()


def test_check_examines_the_fmu_in_this_process() -> None:
    run = told("check", str(CONFIG))
    assert run.returncode == 0, run.stdout + run.stderr
    assert "two fresh instances give the same bits" in run.stdout
    assert "no problem was found" in run.stdout
    assert '"processes"' not in run.stdout  # would be advice that cannot be followed


def test_check_says_in_a_sentence_what_cannot_be_loaded(tmp_path: Path) -> None:
    broken = tmp_path / "broken.fmu"
    broken.write_bytes(b"no archive")
    run = told("check", str(broken))
    assert run.returncode != 0
    assert "Traceback" not in run.stderr + run.stdout
    assert "broken.fmu" in run.stdout + run.stderr


@pytest.mark.parametrize("command", ["fit", "close-loop", "sensitivity"])
def test_processes_are_refused_in_a_sentence(command: str, tmp_path: Path) -> None:
    chosen = ("--out", str(tmp_path / "run"), "executor.name=processes")
    run = told(command, str(CONFIG), *chosen)
    assert run.returncode == 2
    assert run.stderr.startswith('cluster-est: executor.name: "processes" needs a system that can')
    assert run.stderr.endswith('choose "local"\n')
    assert not (tmp_path / "run").exists()


def test_a_replay_says_what_it_lacks(tmp_path: Path) -> None:
    folder = str(tmp_path / "run")
    assert told("fit", str(CONFIG), "--out", folder).returncode == 0
    run = told("replay", folder, "0")
    assert run.returncode == 2
    assert "needs a system that can fork processes" in run.stderr
    assert "Traceback" not in run.stderr
