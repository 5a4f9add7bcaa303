"""A fit and a run of a sweep are one recipe: the same bits and the same facts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

from cluster_est.cli import main
from cluster_est.errors import RunFolderError
from cluster_est.executors.local import LocalExecutor
from cluster_est.run_folder.context import RunContext
from cluster_est.run_folder.evaluation_log import read_log
from cluster_est.toml import to_toml
from workers.messages import Outcome

CLOCKS = {"seconds", "busy_seconds", "started", "ended"}
"""Columns and keys that hold readings of a clock."""


@pytest.fixture
def spring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the embedded example, in which commands run."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "configs" / "mass_spring_damper.toml", "spring.toml")
    shutil.copytree(ROOT / "configs" / "data" / "mass_spring_damper", "data/mass_spring_damper")
    Path("models").mkdir()
    shutil.copy(ROOT / "configs" / "models" / "mass_spring_damper.fmu", "models")
    return tmp_path


def write_sweep(config: str, **keys: Any) -> None:
    Path("sweep.toml").write_text(to_toml({"configs": [config], **keys}), encoding="utf-8")


def tables(run: Path) -> dict[str, str]:
    """Every table of a run as text, without clocks: NaN is not equal to itself."""
    found = {}
    for path in sorted(run.glob("*.parquet")):
        table = pq.read_table(path)
        kept = [name for name in table.column_names if name not in CLOCKS]
        found[path.name] = repr(table.select(kept).to_pylist())
    return found


def facts(run: Path) -> dict[str, Any]:
    return {k: v for k, v in json.loads((run / "run.json").read_text()).items() if k not in CLOCKS}


def logged(run: Path) -> list[tuple[Any, ...]]:
    """What was simulated, in its order."""
    table = read_log(run / "evaluations")
    columns = ("search", "evaluation", "purpose", "experiment", "values", "status", "cost")
    return list(zip(*(map(repr, table[name].to_pylist()) for name in columns), strict=True))


@pytest.mark.parametrize("method", ["least_squares", "sqp"])
@pytest.mark.parametrize("executor", ["local", "processes"])
def test_a_fit_and_a_sweep_of_one_run_are_the_same(
    spring: Path, method: str, executor: str
) -> None:
    chosen = {"method.name": method, "executor.name": executor, "multistart.n": 2}
    write_sweep("spring.toml", overrides=chosen)
    assert main(["sweep", "sweep.toml", "--out", "swept"]) == 0
    overrides = [f"{key}={value}" for key, value in chosen.items()]
    assert main(["fit", "spring.toml", *overrides, "--out", "alone"]) == 0
    swept, alone = spring / "swept" / "spring", spring / "alone"
    assert tables(swept) == tables(alone)
    assert {"errors.parquet", "parameters.parquet", "residuals.parquet"} <= tables(alone).keys()
    assert facts(swept) == facts(alone)
    assert facts(alone)["reset_policy"]["policy"] == "reset"
    assert logged(swept) == logged(alone)
    assert (swept / "config.toml").read_bytes() == (alone / "config.toml").read_bytes()


SLEEPY = """
data_folders = []
[model]
fmu = "misbehaves.fmu"
[parameters]
rate = { start = 1.0, bounds = [0.5, 2.0] }
share = { start = 1.0, fixed = true }
kind = { start = 4.0, fixed = true }
[[experiments]]
id = "e"
data = "decay.csv"
time = "time"
outputs = { x = "x" }
[executor]
name = "processes"
"""


def test_a_sweep_over_the_timeout_uses_what_each_run_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built_fmu: Callable[[str], bytes]
) -> None:
    """Every simulation hangs: how long that is waited for is what its run says."""
    monkeypatch.chdir(tmp_path)
    Path("misbehaves.fmu").write_bytes(built_fmu("misbehaves"))
    Path("decay.csv").write_text("time,x\n0,1\n1,0.4\n2,0.1\n", encoding="utf-8")
    Path("config.toml").write_text(SLEEPY, encoding="utf-8")
    axis = {"name": "timeout", "key": "executor.timeout", "values": [0.4, 0.8]}
    write_sweep("config.toml", axes=[axis])
    assert main(["sweep", "sweep.toml", "--out", "swept"]) == 1
    for limit in ("0.4", "0.8"):
        said = json.loads(Path(f"swept/config-timeout_{limit}/run.json").read_text())["message"]
        assert f"did not end within {limit} s" in said


def test_an_interrupt_before_the_first_simulation_leaves_the_run_that_is_there(
    spring: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["fit", "spring.toml", "--out", "run", "--no-report"]) == 0
    before = tables(spring / "run")

    def interrupted(executor: LocalExecutor) -> list[Outcome]:
        raise KeyboardInterrupt

    monkeypatch.setattr(LocalExecutor, "completed", interrupted)
    assert main(["fit", "spring.toml", "--out", "run", "--overwrite", "--no-report"]) == 130
    assert tables(spring / "run") == before
    assert main(["fit", "spring.toml", "--out", "new", "--no-report"]) == 130
    assert not Path("new").exists()


def test_a_folder_that_cannot_be_written_ends_a_sweep_with_the_reason(
    spring: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(context: RunContext) -> None:
        raise RunFolderError(f"{context.out}: cannot be written (the disk is full)")

    monkeypatch.setattr(RunContext, "begin", full)
    write_sweep("spring.toml")
    assert main(["sweep", "sweep.toml", "--out", "swept"]) == 2
    assert "the disk is full" in capsys.readouterr().err
    assert [row["status"] for row in pq.read_table("swept/summary.parquet").to_pylist()] == [
        "not run"
    ]
