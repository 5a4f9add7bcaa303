"""A fit that is interrupted writes what it has, says so, and can be taken up again."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
SLOW = (
    *("model.interface=model_exchange", "model.solver=rk4", "model.step=2e-4"),
    *("multistart.n=10", "parameters.c.bounds=[0.0, 2.0]"),
)
FEWER = "multistart.n=3", "model.step=2e-3"


def start(out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "cluster_est.cli", "fit", str(CONFIG), "--out", str(out)]
    return subprocess.Popen(
        [*command, *SLOW, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_for_searches(out: Path, process: subprocess.Popen, size: int) -> None:
    """Until the log has grown to a size in bytes; the starts alone, 10 at most, take 170 kB."""
    log = out / "evaluations" / "00000.arrows"
    while process.poll() is None and (not log.is_file() or log.stat().st_size < size):
        time.sleep(0.02)


@pytest.mark.parametrize("executor", ["local", "processes"])
@pytest.mark.parametrize("how", ["ctrl-c", "terminate", "stop file"])
def test_the_best_so_far_is_written(tmp_path, executor, how):
    run = tmp_path / "run"
    process = start(run, f"executor.name={executor}", "executor.workers=2")
    wait_for_searches(run, process, 1_000_000)
    if how == "stop file":
        (run / "stop").touch()
    else:
        process.send_signal(signal.SIGINT if how == "ctrl-c" else signal.SIGTERM)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in said
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    assert facts["status"] == "interrupted"
    assert facts["cost"] < facts["cost_before"]
    assert not (run / "stop").exists()
    assert pq.read_table(run / "parameters.parquet").num_rows > 0
    endings = set(pq.read_table(run / "searches.parquet")["ending"].to_pylist())
    assert "interrupted" in endings


def test_an_interrupted_run_is_taken_up_again_with_the_same_bits(tmp_path):
    once = start(tmp_path / "once", "executor.workers=2", *FEWER)
    interrupted = start(tmp_path / "again", *FEWER)
    wait_for_searches(tmp_path / "again", interrupted, 150_000)
    interrupted.send_signal(signal.SIGINT)
    interrupted.communicate(timeout=120)
    assert interrupted.returncode == 130
    again = start(tmp_path / "again", "--resume", *FEWER)
    for process in (once, again):
        process.communicate(timeout=300)
        assert process.returncode == 0
    for table in ("parameters", "minima", "searches", "errors", "residuals"):
        files = [tmp_path / name / f"{table}.parquet" for name in ("once", "again")]
        assert files[0].read_bytes() == files[1].read_bytes()
