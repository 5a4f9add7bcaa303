"""Where and on how many workers a fit runs changes no bit of it."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.run_folders import SPRING

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log

TABLES = ("parameters", "errors", "residuals", "trajectories")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], Path]:
    """Give the run of an executor with so many workers."""

    @cache
    def give(executor: str, workers: int) -> Path:
        folder = tmp_path_factory.mktemp("runs") / "run"
        where = f"executor.name={executor}", f"executor.workers={workers}"
        assert main(["fit", SPRING, "--out", str(folder), "--no-report", *where]) == 0
        return folder

    return give


def evaluations(folder):
    """What was simulated and came out, in an order that does not depend on arrival."""
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values"]
    table = read_log(folder / "evaluations")
    table = table.select([*columns, "residuals_hash", "status", "cost"])
    assert table["residuals_hash"].null_count == 0
    return table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()


@pytest.mark.parametrize(
    ("executor", "workers"),
    [("local", 3), ("ray", 2), pytest.param("ray", 1, marks=pytest.mark.slow)],
)
def test_tables_and_evaluations_are_identical(run, executor, workers):
    usual, other = run("local", 1), run(executor, workers)
    for table in TABLES:
        first, second = (folder / f"{table}.parquet" for folder in (usual, other))
        assert first.read_bytes() == second.read_bytes()
    assert evaluations(usual) == evaluations(other)


def test_tables_carry_the_config_hash(run):
    metadata = pq.read_schema(run("local", 1) / "parameters.parquet").metadata
    assert len(metadata[b"cluster_est.config_hash"]) == 64
