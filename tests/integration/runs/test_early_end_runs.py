"""Runs that end simulations early: what they find, what their log says, and its replay."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log

CONFIG = str(ROOT / "configs" / "mass_spring_damper.toml")
DE = ["method.name=de", "method.options.population=10", "budget.evaluations=150"]
EARLY = "method.options.early_end=true"
RUNS = {
    "to the end": ["executor.name=local"],
    "local-1": ["executor.name=local", EARLY],
    "local-3": ["executor.name=local", "executor.workers=3", EARLY],
    "processes-2": ["executor.name=processes", "executor.workers=2", EARLY],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {}
    for name, overrides in RUNS.items():
        folders[name] = tmp_path_factory.mktemp("runs") / name
        arguments = ["fit", CONFIG, "--out", str(folders[name]), *DE, *overrides]
        assert main(arguments) == 1  # the budget is used up
    return folders


def evaluations(run: Path) -> list[dict[str, object]]:
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values"]
    table = read_log(run / "evaluations")
    table = table.select([*columns, "residuals_hash", "status", "message", "bound"])
    return table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()


def ended(run: Path) -> list[int]:
    statuses = read_log(run / "evaluations")["status"].to_pylist()
    return [number for number, status in enumerate(statuses) if status == "ended early"]


@pytest.mark.parametrize("other", ["local-3", "processes-2"])
def test_the_log_is_the_same_on_any_workers(runs, other):
    assert len(ended(runs["local-1"])) > 20
    assert evaluations(runs["local-1"]) == evaluations(runs[other])


@pytest.mark.parametrize("table", ["parameters", "errors", "searches", "residuals"])
def test_what_is_found_is_the_same(runs, table):
    rows = [pq.read_table(runs[name] / f"{table}.parquet").to_pylist() for name in RUNS]
    assert len({repr(each) for each in rows}) == 1  # the text, in which NaN is the same as NaN


def test_it_is_no_failure(runs, capfd):
    run = runs["processes-2"]
    assert sum(pq.read_table(run / "workers.parquet")["failures"].to_pylist()) == 0
    capfd.readouterr()
    assert main(["show", str(run), "--failures"]) == 0
    assert "no simulation failed" in capfd.readouterr().out


def test_its_replay_ends_as_early(runs, capfd):
    run = runs["local-1"]
    for number in (ended(run)[0], ended(run)[-1]):
        capfd.readouterr()
        assert main(["replay", str(run), str(number), "--config", CONFIG]) == 0
        out = capfd.readouterr().out
        assert "then: ended early: its sum of squares was above the bound already at t = " in out
        assert out.endswith("it was ended early, as it was then\n")
