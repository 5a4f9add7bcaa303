"""`replay` runs one logged simulation again, whatever the FMU does; `show --failures` finds it."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.problems.springs import ROOT
from support.spoiled import write_input

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log
from cluster_est.toml import to_toml

KEPT = "log.keep_residuals=true"
Capture = pytest.CaptureFixture[str]


def fit(folder: Path, *overrides: str) -> Path:
    """Fit the config in a folder, and give the run's folder."""
    out = folder / "run"
    arguments = ["fit", str(folder / "config.toml"), "--out", str(out), *overrides]
    assert main(arguments) in (0, 1)
    return out


def failing(folder: Path, fmu: bytes) -> None:
    """Write a problem whose second start is where the FMU fails."""
    times = np.linspace(0.0, 2.0, 21)
    rows = [f"{t!r},0,{math.exp(-t)!r}\n" for t in times.tolist()]
    (folder / "a.csv").write_text("time,u,y\n" + "".join(rows))
    (folder / "x.fmu").write_bytes(fmu)
    tree: dict[str, Any] = {
        "model": {"fmu": "x.fmu"},
        "parameters": {"decay": {"start": 1.5, "bounds": [0.1, 5.0], "variable": "rate"}},
        "experiments": [
            {
                "id": "a",
                "data": "a.csv",
                "time": "time",
                "inputs": {"u": "u"},
                "outputs": {"y": "y"},
            }
        ],
        "multistart": {"n": 2, "points": [{"decay": 3.0}]},
    }
    (folder / "config.toml").write_text(to_toml(tree))


def failures(run: Path) -> list[int]:
    log = read_log(run / "evaluations")["status"].to_pylist()
    return [number for number, status in enumerate(log) if status != "ok"]


def shown(capture: pytest.CaptureFixture[str]) -> tuple[str, str]:
    out, err = capture.readouterr()
    return out, err


def test_what_succeeded_gives_the_same_bits_again(tmp_path, capfd: Capture):
    config = write_input(tmp_path)
    run = fit(tmp_path)
    rows = read_log(run / "evaluations").to_pylist()
    capfd.readouterr()
    for number in (0, len(rows) - 1):
        assert main(["replay", str(run), str(number), "--config", str(config)]) == 0
        out, err = shown(capfd)
        assert f"evaluation {number}: experiment a\n" in out
        assert f"search {rows[number]['search']}, point " in out
        assert f"m          {rows[number]['values'][0]!r}\n" in out
        assert out.endswith("its residuals agree with the logged ones bit for bit\n")
        assert err == ""
        assert "not those of the run" not in out


def test_what_the_fmu_says_is_shown(tmp_path, capfd: Capture, built_fmu: Callable[[str], bytes]):
    failing(tmp_path, built_fmu("talks"))
    run = fit(tmp_path)
    failed = failures(run)
    capfd.readouterr()

    assert main(["show", str(run), "--failures"]) == 0
    out, _ = shown(capfd)
    lines = [line for line in out.splitlines() if re.match(r"\d", line)]
    assert [int(line.split()[0]) for line in lines] == failed
    assert all("rate 3 is too much" in line for line in lines)

    number, config = str(failed[0]), str(tmp_path / "config.toml")
    assert main(["replay", str(run), number, "--config", config]) == 1
    out, err = shown(capfd)
    assert err == "error: rate 3 is too much\n"
    assert "decay (rate)  3.0\n" in out
    assert "then: solver failure: " in out
    assert "now: solver failure: " in out
    assert out.endswith("it failed as it did then\n")


def test_a_crash_is_told_by_its_signal(tmp_path, capfd: Capture, built_fmu):
    failing(tmp_path, built_fmu("crashes"))
    run = fit(tmp_path, "executor.name=processes")
    number = failures(run)[0]
    capfd.readouterr()
    config = str(tmp_path / "config.toml")
    assert main(["replay", str(run), str(number), "--config", config]) == 1
    out, _ = shown(capfd)
    assert "then: crash: the process crashed during this simulation (SIGABRT)" in out
    assert "now: crash: the process crashed during this simulation (SIGABRT)" in out


def test_where_the_files_of_the_config_are(tmp_path, capfd: Capture):
    write_input(tmp_path)
    run = fit(tmp_path)
    capfd.readouterr()

    def refused(*arguments: str) -> str:
        assert main(["replay", str(run), "0", *arguments]) == 2
        _, err = shown(capfd)
        assert err.count("\n") == 1
        return err

    def told(folder: str | None) -> None:
        facts = json.loads((run / "run.json").read_text()) | {"config_folder": folder}
        (run / "run.json").write_text(json.dumps(facts))

    told(None)
    assert "name the config that it was made from with --config" in refused()
    told(str(tmp_path / "no"))
    assert "which is not here; name the config with --config" in refused()
    assert "there is no config file no.toml" in refused("--config", "no.toml")
    told(str(tmp_path))
    assert main(["replay", str(run), "0"]) == 0


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        (True, "1 of 4 residuals differ, by at most 0.01\n"),
        (False, "keep its residuals; their hashes differ, and their sums of squares differ by "),
    ],
)
def test_other_data_are_said(tmp_path, capfd: Capture, kept, said):
    config = write_input(tmp_path)
    run = fit(tmp_path, KEPT)
    if not kept:
        rewrite(run, column("residuals", None))
    write_input(tmp_path, rows="time,force,position\n0,1,0\n0.1,1,0.01\n0.2,0,0.03\n0.3,0,0.01\n")
    capfd.readouterr()
    assert main(["replay", str(run), "0", "--config", str(config)]) == 0
    out, _ = shown(capfd)
    assert "note: the FMU, its solver, the data" in out
    assert said in out


def rewrite(run: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Put another log in the place of a run's own."""
    table = change(read_log(run / "evaluations"))
    shutil.rmtree(run / "evaluations")
    (run / "evaluations").mkdir()
    with pa.ipc.new_stream(run / "evaluations" / "00000.arrows", table.schema) as writer:
        writer.write_table(table)


def column(name: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        at = table.schema.get_field_index(name)
        values = pa.array([value] * table.num_rows, table.schema.field(name).type)
        return table.set_column(at, table.schema.field(name), values)

    return change


def test_a_log_without_residuals_still_has_their_squares(tmp_path, capfd: Capture):
    config = write_input(tmp_path)
    run = fit(tmp_path)
    rewrite(run, column("residuals", None))
    rewrite(run, column("residuals_hash", None))
    capfd.readouterr()
    assert main(["replay", str(run), "0", "--config", str(config)]) == 0
    out, _ = shown(capfd)
    assert out.endswith("the log does not keep its residuals; their sums of squares are the same\n")


@pytest.mark.parametrize(
    ("cost", "want", "summed"),
    [("sse", "squares", "squares"), ("sae", "absolutes", "absolute values")],
)
def test_what_was_reduced_is_reduced_again(tmp_path, capfd: Capture, cost, want, summed):
    run = tmp_path / "run"
    small = "method.name=de", "budget.evaluations=10", f"cost.name={cost}", KEPT
    config = str(ROOT / "configs" / "mass_spring_damper.toml")
    assert main(["fit", config, "--out", str(run), *small]) in (0, 1)
    log = read_log(run / "evaluations")
    number = log["want"].to_pylist().index(want)
    (row,) = log.slice(number, 1).to_pylist()
    assert len(row["residuals"]) == 1
    (found,) = row["residuals"]
    assert row["cost"] == pytest.approx(found**2 if cost == "sse" else found, rel=1e-15)
    capfd.readouterr()
    assert main(["replay", str(run), str(number)]) == 0
    out, _ = shown(capfd)
    assert f"then: ok, sum of {summed} " in out
    assert f"now: ok, sum of {summed} " in out
    assert out.endswith("its residuals agree with the logged ones bit for bit\n")
    rewrite(run, column("residuals", None))
    rewrite(run, column("residuals_hash", None))
    assert main(["replay", str(run), str(number)]) == 0
    out, _ = shown(capfd)
    assert out.endswith(f"does not keep its residuals; their sums of {summed} are the same\n")


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("experiment", "b", "must be of an experiment of the config to be replayed but is of 'b'"),
        ("effects", ["drag"], "has 'drag', which a closed loop tried; add it to the config"),
        ("values", [1.0], "must have 2 values, as the config does, but has 1"),
    ],
)
def test_what_the_config_does_not_name(tmp_path, capfd: Capture, name, value, sentence):
    config = write_input(tmp_path)
    run = fit(tmp_path)
    rewrite(run, column(name, value))
    capfd.readouterr()
    assert main(["replay", str(run), "0", "--config", str(config)]) == 2
    _, err = shown(capfd)
    assert f"{run}, evaluation 0: " in err
    assert sentence in err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["replay", "{run}", "100000"], "an ID must be from 0 to "),
        (["replay", "{folder}", "0"], "must be the folder of a run but has no run.json"),
        (["show", "{folder}", "--failures"], "must be the folder of a run but has no run.json"),
    ],
)
def test_bad_arguments(tmp_path, capfd: Capture, arguments, sentence):
    write_input(tmp_path)
    run = fit(tmp_path)
    capfd.readouterr()
    assert main([a.format(run=run, folder=tmp_path) for a in arguments]) == 2
    _, err = shown(capfd)
    assert sentence in err


def test_a_run_without_failures_says_so(tmp_path, capfd: Capture):
    write_input(tmp_path)
    run = fit(tmp_path)
    capfd.readouterr()
    assert main(["show", str(run), "--failures"]) == 0
    assert shown(capfd)[0] == f"run {run}: no simulation failed\n"


def test_a_config_with_effects(tmp_path, capfd: Capture):
    tree = (ROOT / "scripts" / "fuzzing" / "full.toml").read_text()
    (tmp_path / "models").symlink_to(ROOT / "configs" / "models")
    (tmp_path / "data").symlink_to(ROOT / "configs" / "data")
    config = tmp_path / "config.toml"
    config.write_text(tree)
    run = fit(tmp_path, "budget.evaluations=3")
    capfd.readouterr()
    assert main(["replay", str(run), "0", "--config", str(config)]) == 0
    out, _ = shown(capfd)
    assert "\nfriction.k " in out
    assert "\neffect friction at der(v): coulomb\n" in out
    assert "\neffect own at output y: a * y + b * t\n" in out
    assert "bit for bit" in out
