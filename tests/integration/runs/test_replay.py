import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.cut_logs import write_log
from support.problems.springs import ROOT
from support.run_folders import SPRING, change_facts
from support.spoiled import write_input

from cluster_est.cli import main
from cluster_est.run_folder.log_segment import read_log
from cluster_est.toml import to_toml

KEPT = "log.keep_residuals=true"
OTHER_ROWS = "time,force,position\n0,1,0\n0.1,1,0.01\n0.2,0,0.03\n0.3,0,0.01\n"

Replay = Callable[..., str]


def fit(folder: Path, *overrides: str, config: str = "config.toml") -> Path:
    """Fit a config in a folder, and give the run's folder."""
    arguments = ["fit", str(folder / config), "--out", str(folder / "run"), "--no-report"]
    assert main([*arguments, *overrides]) in (0, 1)
    return folder / "run"


def failing(folder: Path, fmu: bytes) -> None:
    """Write a problem whose second start is where the FMU fails."""
    times = np.linspace(0.0, 2.0, 21)
    rows = [f"{t!r},0,{math.exp(-t)!r}\n" for t in times.tolist()]
    (folder / "a.csv").write_text("time,u,y\n" + "".join(rows))
    (folder / "x.fmu").write_bytes(fmu)
    record = {"id": "a", "data": "a.csv", "time": "time"}
    tree: dict[str, Any] = {
        "model": {"fmu": "x.fmu"},
        "parameters": {"decay": {"start": 1.5, "bounds": [0.1, 5.0], "variable": "rate"}},
        "experiments": [record | {"inputs": {"u": "u"}, "outputs": {"y": "y"}}],
        "multistart": {"n": 2, "points": [{"decay": 3.0}]},
    }
    (folder / "config.toml").write_text(to_toml(tree))


def failures(run: Path) -> list[int]:
    log = read_log(run / "evaluations")["status"].to_pylist()
    return [number for number, status in enumerate(log) if status != "ok"]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a small config, whose log keeps its residuals."""
    folder = tmp_path_factory.mktemp("fitted")
    write_input(folder)
    return fit(folder, KEPT)


@pytest.fixture
def run(fitted: Path, tmp_path: Path) -> Path:
    """A copy of that run and of what it was made from."""
    return Path(shutil.copytree(fitted.parent, tmp_path / "copy")) / "run"


@pytest.fixture
def replay(capfd: pytest.CaptureFixture[str]) -> Replay:
    """Replays an evaluation of a run with the config beside it, and gives what is said."""

    def do(run: Path, number: int, expected: int = 0) -> str:
        capfd.readouterr()
        config = str(run.parent / "config.toml")
        assert main(["replay", str(run), str(number), "--config", config]) == expected
        out, err = capfd.readouterr()
        return err if expected == 2 else out + err

    return do


def rewrite(run: Path, **values: Any) -> None:
    """Put a log with other values in some columns in the place of a run's own."""
    table = read_log(run / "evaluations")
    for name, value in values.items():
        at = table.schema.get_field_index(name)
        column = pa.array([value] * table.num_rows, table.schema.field(name).type)
        table = table.set_column(at, table.schema.field(name), column)
    shutil.rmtree(run / "evaluations")
    (run / "evaluations").mkdir()
    write_log(run / "evaluations", table)


def test_what_succeeded_gives_the_same_bits_again(fitted, replay):
    rows = read_log(fitted / "evaluations").to_pylist()
    for number in (0, len(rows) - 1):
        out = replay(fitted, number)
        assert f"evaluation {number}: experiment a\n" in out
        assert f"search {rows[number]['search']}, point " in out
        assert f"m          {rows[number]['values'][0]!r}\n" in out
        assert out.endswith("the residuals agree with the logged ones bit for bit\n")
        assert "not the same as in the run" not in out


def test_what_the_fmu_says_is_shown(tmp_path, capfd, replay, built_fmu):
    failing(tmp_path, built_fmu("talks"))
    run = fit(tmp_path)
    failed = failures(run)
    capfd.readouterr()
    assert main(["show", str(run), "--failures"]) == 0
    lines = [line for line in capfd.readouterr().out.splitlines() if re.match(r"\d", line)]
    assert [int(line.split()[0]) for line in lines] == failed
    assert all("rate 3 is too much" in line for line in lines)

    said = replay(run, failed[0], 1)
    assert said.endswith("error: rate 3 is too much\n")
    assert "decay (rate)  3.0\n" in said
    assert "then: solver failure: " in said
    assert "now: solver failure: " in said
    assert "the simulation failed as in the run\n" in said


def test_a_crash_is_told_by_its_signal(tmp_path, replay, built_fmu):
    failing(tmp_path, built_fmu("crashes"))
    run = fit(tmp_path, "executor.name=processes")
    out = replay(run, failures(run)[0], 1)
    assert "then: crash: the process crashed during this simulation (SIGABRT)" in out
    assert "now: crash: the process crashed during this simulation (SIGABRT)" in out


def test_where_the_files_of_the_config_are(run, capfd):
    for folder, arguments, said in (
        (None, [], "name the original config with --config"),
        (
            str(run / "no"),
            [],
            "which does not exist on this machine; name the config with --config",
        ),
        (str(run / "no"), ["--config", "no.toml"], "there is no config file no.toml"),
    ):
        change_facts(run, config_folder=folder)
        capfd.readouterr()
        assert main(["replay", str(run), "0", *arguments]) == 2
        err = capfd.readouterr().err
        assert said in err
        assert err.count("\n") == 1
    change_facts(run, config_folder=str(run.parent))
    assert main(["replay", str(run), "0"]) == 0


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        ([], "1 of 4 residuals differ, by at most 0.01\n"),
        (["residuals"], "their hashes differ, and the sums of squares differ by "),
    ],
)
def test_other_data_are_said(run, replay, gone, said):
    rewrite(run, **dict.fromkeys(gone))
    write_input(run.parent, rows=OTHER_ROWS)
    out = replay(run, 0)
    assert "note: the FMU, its solver, the data" in out
    assert said in out


def test_a_log_without_residuals_still_has_their_squares(run, replay):
    rewrite(run, residuals=None, residuals_hash=None)
    said = "the log does not keep the residuals; the sums of squares are the same as now\n"
    assert replay(run, 0).endswith(said)


@pytest.mark.parametrize(
    ("cost", "want", "summed"),
    [("sse", "squares", "squares"), ("sae", "absolutes", "absolute values")],
)
def test_what_was_reduced_is_reduced_again(tmp_path, capfd, cost, want, summed):
    small = "method.name=de", "budget.evaluations=10", f"cost.name={cost}", KEPT
    run = fit(tmp_path, *small, config=SPRING)
    log = read_log(run / "evaluations")
    number = log["want"].to_pylist().index(want)
    (row,) = log.slice(number, 1).to_pylist()
    (found,) = row["residuals"]
    assert row["cost"] == pytest.approx(found**2 if cost == "sse" else found, rel=1e-15)
    capfd.readouterr()
    assert main(["replay", str(run), str(number)]) == 0
    out = capfd.readouterr().out
    assert f"then: ok, sum of {summed} " in out
    assert f"now: ok, sum of {summed} " in out
    assert out.endswith("the residuals agree with the logged ones bit for bit\n")
    rewrite(run, residuals=None, residuals_hash=None)
    assert main(["replay", str(run), str(number)]) == 0
    said = f"does not keep the residuals; the sums of {summed} are the same as now\n"
    assert capfd.readouterr().out.endswith(said)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("experiment", "b", "its experiment must be in the config, but is 'b'"),
        ("effects", ["drag"], "'drag', which the search for missing effects tried, is not; add it"),
        ("values", [1.0], "has 1 values, but"),
    ],
)
def test_what_the_config_does_not_name(run, replay, name, value, sentence):
    rewrite(run, **{name: value})
    said = replay(run, 0, 2)
    assert f"{run}, evaluation 0: " in said
    assert sentence in said


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["replay", "{run}", "100000"],
            "the ID of a simulation must be a row of the log, from 0 to ",
        ),
        (["replay", "{folder}", "0"], "must be the folder of a run, but has no run.json"),
        (["show", "{folder}", "--failures"], "must be the folder of a run, but has no run.json"),
    ],
)
def test_bad_arguments(fitted, capfd, arguments, sentence):
    assert main([a.format(run=fitted, folder=fitted.parent) for a in arguments]) == 2
    assert sentence in capfd.readouterr().err


def test_a_config_with_effects(tmp_path, replay):
    for name in ("models", "data"):
        (tmp_path / name).symlink_to(ROOT / "configs" / name)
    shutil.copy(ROOT / "scripts" / "fuzzing" / "full.toml", tmp_path / "config.toml")
    out = replay(fit(tmp_path, "budget.evaluations=3"), 0)
    assert "\nfriction.k " in out
    assert "\neffect friction at der(v): coulomb\n" in out
    assert "\neffect own at output y: a * y + b * t\n" in out
    assert "bit for bit" in out
