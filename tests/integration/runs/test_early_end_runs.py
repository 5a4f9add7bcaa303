from collections.abc import Callable
from functools import cache
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.run_folders import SPRING, evaluations, rows, tables

from cluster_est.cli import main
from cluster_est.run_folder.log_segment import read_log

DE = ["method.name=de", "method.options.population=10", "budget.evaluations=150"]
EARLY = [*DE, "method.options.early_end=true"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Give the run of an executor with so many workers."""

    @cache
    def give(executor: str, workers: int, *arguments: str) -> Path:
        folder = tmp_path_factory.mktemp("runs") / "run"
        where = f"executor.name={executor}", f"executor.workers={workers}"
        code = main(["fit", SPRING, "--out", str(folder), "--no-report", *where, *arguments])
        assert code == (1 if arguments else 0)  # the budget of DE is used up
        return folder

    return give


@pytest.mark.parametrize(
    ("executor", "workers"),
    [("local", 3), *(pytest.param("ray", n, marks=pytest.mark.slow) for n in (1, 2))],
)
def test_tables_and_evaluations_are_identical(run, executor, workers):
    usual, other = run("local", 1), run(executor, workers)
    for table in ("parameters", "errors", "residuals", "trajectories"):
        first, second = (folder / f"{table}.parquet" for folder in (usual, other))
        assert first.read_bytes() == second.read_bytes()
    assert evaluations(usual) == evaluations(other)


def test_tables_carry_the_config_hash(run):
    metadata = pq.read_schema(run("local", 1) / "parameters.parquet").metadata
    assert len(metadata[b"cluster_est.config_hash"]) == 64


def ended(run: Path) -> list[int]:
    statuses = read_log(run / "evaluations")["status"].to_pylist()
    return [number for number, status in enumerate(statuses) if status == "ended early"]


@pytest.mark.parametrize(
    ("executor", "workers"), [("processes", 2), pytest.param("local", 3, marks=pytest.mark.slow)]
)
def test_what_an_early_end_finds_and_logs_is_the_same_on_any_workers(run, executor, workers):
    usual, other = run("local", 1, *EARLY), run(executor, workers, *EARLY)
    assert len(ended(usual)) > 20
    assert evaluations(usual) == evaluations(other)
    for name in ("parameters", "errors", "searches", "residuals"):
        assert tables(other)[name] == tables(usual)[name] == tables(run("local", 1, *DE))[name]


def test_an_early_end_is_no_failure(run, capfd):
    folder = run("processes", 2, *EARLY)
    assert sum(row["failures"] for row in rows(folder, "workers")) == 0
    capfd.readouterr()
    assert main(["show", str(folder), "--failures"]) == 0
    assert "no simulation failed" in capfd.readouterr().out


def test_the_replay_of_an_early_end_ends_as_early(run, capfd):
    folder = run("local", 1, *EARLY)
    for number in (ended(folder)[0], ended(folder)[-1]):
        capfd.readouterr()
        assert main(["replay", str(folder), str(number), "--config", SPRING]) == 0
        out = capfd.readouterr().out
        assert "then: ended early: the sum of squares had already exceeded the limit at t = " in out
        assert out.endswith("the simulation was ended early, as in the run\n")
