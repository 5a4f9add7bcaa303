"""A fit and a run of a sweep are one recipe: the same bits and the same facts."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from support.observed_executor import observe
from support.run_folders import copy_spring, facts, facts_without_clocks, rows, tables
from support.thinning import thinned

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log
from cluster_est.toml import to_toml


@pytest.fixture
def spring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the embedded example, in which commands run."""
    monkeypatch.chdir(tmp_path)
    copy_spring(tmp_path)
    return tmp_path


def write_sweep(config: str, **keys: Any) -> None:
    Path("sweep.toml").write_text(to_toml({"configs": [config], **keys}), encoding="utf-8")


def logged(run: Path) -> list[tuple[Any, ...]]:
    """What was simulated, in its order."""
    table = read_log(run / "evaluations")
    columns = ("search", "evaluation", "purpose", "experiment", "values", "status", "cost")
    return list(zip(*(map(repr, table[name].to_pylist()) for name in columns), strict=True))


@pytest.mark.parametrize(
    ("method", "executor"),
    thinned(
        [*product(["least_squares", "sqp"], ["local", "processes"])],
        lambda method, _: method,
        lambda _, executor: executor,
    ),
)
def test_a_fit_and_a_sweep_of_one_run_are_the_same(
    spring: Path, method: str, executor: str
) -> None:
    chosen = {"method.name": method, "executor.name": executor, "multistart.n": 2}
    write_sweep("spring.toml", overrides=chosen)
    assert main(["sweep", "sweep.toml", "--out", "swept"]) == 0
    overrides = [f"{key}={value}" for key, value in chosen.items()]
    assert main(["fit", "spring.toml", *overrides, "--out", "alone", "--no-report"]) == 0
    swept, alone = spring / "swept" / "spring", spring / "alone"
    assert tables(swept) == tables(alone)
    assert {"errors", "parameters", "residuals"} <= tables(alone).keys()
    assert facts_without_clocks(swept) == facts_without_clocks(alone)
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
        said = facts(Path(f"swept/config-timeout_{limit}"))["message"]
        assert f"did not end within {limit} s" in said


def test_an_interrupt_before_the_first_simulation_leaves_the_run_that_is_there(
    spring: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["fit", "spring.toml", "--out", "run", "--no-report"]) == 0
    before = tables(spring / "run")

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    observe(monkeypatch).before = interrupt
    for how in (["--out", "run", "--overwrite"], ["--out", "new"]):
        assert main(["fit", "spring.toml", *how, "--no-report"]) == 130
    assert tables(spring / "run") == before
    assert not Path("new").exists()


def test_a_folder_that_cannot_be_written_ends_a_sweep_with_the_reason(
    spring: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A log that is a file in its place stands for a full disk: nothing can be written to it."""
    run = spring / "swept" / "spring"
    run.mkdir(parents=True)
    (run.parent / "sweep.json").touch()
    (run / "run.json").write_text("{")
    (run / "evaluations").touch()
    write_sweep("spring.toml")
    assert main(["sweep", "sweep.toml", "--out", "swept"]) == 2
    assert "evaluations" in capsys.readouterr().err
    assert [row["status"] for row in rows(spring / "swept", "summary")] == ["not run"]
