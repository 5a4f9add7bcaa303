"""Runs that end simulations early: what they find, what their log says, and its replay."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from support.run_folders import SPRING, rows, tables

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log

DE = ["method.name=de", "method.options.population=10", "budget.evaluations=150"]
EARLY = "method.options.early_end=true"
RUNS = {
    "to the end": ["executor.name=local"],
    "local-1": ["executor.name=local", EARLY],
    "local-3": ["executor.name=local", "executor.workers=3", EARLY],
    "processes-2": ["executor.name=processes", "executor.workers=2", EARLY],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Give the folder of a run."""

    @cache
    def give(name: str) -> Path:
        folder = tmp_path_factory.mktemp("runs") / "run"
        arguments = ["fit", SPRING, "--out", str(folder), "--no-report", *DE, *RUNS[name]]
        assert main(arguments) == 1  # the budget is used up
        return folder

    return give


def evaluations(run: Path) -> list[dict[str, object]]:
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values"]
    table = read_log(run / "evaluations")
    table = table.select([*columns, "residuals_hash", "status", "message", "bound"])
    return table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()


def ended(run: Path) -> list[int]:
    statuses = read_log(run / "evaluations")["status"].to_pylist()
    return [number for number, status in enumerate(statuses) if status == "ended early"]


@pytest.mark.parametrize("other", ["processes-2", pytest.param("local-3", marks=pytest.mark.slow)])
def test_what_is_found_and_logged_is_the_same_on_any_workers(run, other):
    assert len(ended(run("local-1"))) > 20
    assert evaluations(run("local-1")) == evaluations(run(other))
    found = tables(run(other))
    for name in ("parameters", "errors", "searches", "residuals"):
        assert found[name] == tables(run("local-1"))[name] == tables(run("to the end"))[name]


def test_it_is_no_failure(run, capfd):
    assert sum(row["failures"] for row in rows(run("processes-2"), "workers")) == 0
    capfd.readouterr()
    assert main(["show", str(run("processes-2")), "--failures"]) == 0
    assert "no simulation failed" in capfd.readouterr().out


def test_its_replay_ends_as_early(run, capfd):
    folder = run("local-1")
    for number in (ended(folder)[0], ended(folder)[-1]):
        capfd.readouterr()
        assert main(["replay", str(folder), str(number), "--config", SPRING]) == 0
        out = capfd.readouterr().out
        assert "then: ended early: its sum of squares was above the bound already at t = " in out
        assert out.endswith("it was ended early, as it was then\n")
