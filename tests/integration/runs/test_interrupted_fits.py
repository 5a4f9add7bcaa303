import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
from support.observed_executor import observe
from support.run_folders import SPRING, facts, rows, tables
from support.thinning import thinned

from cluster_est.cli import main

HOW: dict[str, Callable[[int, Path], None]] = {
    "terminate": lambda process, _: os.kill(process, signal.SIGTERM),
    "stop file": lambda _, run: (run / "stop").touch(),
    "ctrl-c": lambda process, _: os.kill(process, signal.SIGINT),
}
STARTS = "multistart.n=10", "parameters.c.bounds=[0.0, 2.0]"
SLOW = "model.interface=model_exchange", "model.solver=rk4", "model.step=2e-4", *STARTS


@pytest.mark.parametrize(
    ("how", "executor"),
    thinned(
        [
            pytest.param(how, executor, marks=pytest.mark.slow if how == "terminate" else ())
            for how, executor in product(HOW, ["processes", "local"])
        ],
        lambda how, _: how,
        lambda _, executor: executor,
    ),
)
def test_a_program_that_is_interrupted_writes_the_best_so_far(tmp_path, how, executor):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "cluster_est", "fit", SPRING, "--out", str(run), *SLOW]
    where = f"executor.name={executor}", "executor.workers=2", "--no-report"
    with subprocess.Popen([*command, *where], stderr=subprocess.PIPE, text=True) as process:
        log = run / "evaluations" / "00000.arrows"
        # until the searches are under way: the starts alone take 170 kB
        while process.poll() is None and (not log.is_file() or log.stat().st_size < 400_000):
            time.sleep(0.02)
        HOW[how](process.pid, run)
        _, said = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in said
    found = facts(run)
    assert found["status"] == "interrupted"
    assert found["cost"] < found["cost_before"]
    assert not (run / "stop").exists()
    assert rows(run, "parameters")
    assert "interrupted" in {row["ending"] for row in rows(run, "searches")}


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a command has no parent process")
@pytest.mark.parametrize("seconds", [0.0, 0.03, 0.1, 0.2, 0.4])
def test_interrupts_while_libraries_are_loaded_are_not_lost(tmp_path, seconds):
    """From the moment on in which its process is there, whatever that is importing."""
    command = [sys.executable, "-m", "cluster_est", "fit", SPRING, "--out", str(tmp_path / "r")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        while not children.read_text():
            time.sleep(0.001)
        time.sleep(seconds)
        for _ in range(2):
            os.kill(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted" in said
    assert "Traceback" not in said


def test_an_interrupt_before_the_first_simulation_leaves_the_run_that_is_there(
    tmp_path, monkeypatch
):
    fit = ["fit", SPRING, "--no-report", "--out"]
    assert main([*fit, str(tmp_path / "run")]) == 0
    before = tables(tmp_path / "run")

    def interrupt(_):
        raise KeyboardInterrupt

    observe(monkeypatch).before = interrupt
    for how in ([str(tmp_path / "run"), "--overwrite"], [str(tmp_path / "new")]):
        assert main([*fit, *how]) == 130
    assert tables(tmp_path / "run") == before
    assert not (tmp_path / "new").exists()
