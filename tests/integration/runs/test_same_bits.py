"""Where and on how many workers a fit runs changes no bit of it."""

from __future__ import annotations

import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log

EXECUTORS = {
    "local-1": ["executor.name=local"],
    "local-3": ["executor.name=local", "executor.workers=3"],
    "ray-1": ["executor.name=ray", "executor.workers=1"],
    "ray-2": ["executor.name=ray", "executor.workers=2"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folders = {}
    for name, overrides in EXECUTORS.items():
        folders[name] = tmp_path_factory.mktemp("runs") / name
        config = str(ROOT / "configs" / "mass_spring_damper.toml")
        assert main(["fit", config, "--out", str(folders[name]), *overrides]) == 0
    return folders


def evaluations(folder):
    """What was simulated and came out, in an order that does not depend on arrival."""
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values"]
    table = read_log(folder / "evaluations")
    table = table.select([*columns, "residuals_hash", "status", "cost"])
    assert table["residuals_hash"].null_count == 0
    return table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()


@pytest.mark.parametrize("other", list(EXECUTORS)[1:])
@pytest.mark.parametrize("table", ["parameters", "errors", "residuals", "trajectories"])
def test_tables_are_byte_identical(runs, other, table):
    first, second = (runs[name] / f"{table}.parquet" for name in ("local-1", other))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("other", list(EXECUTORS)[1:])
def test_evaluations_are_identical(runs, other):
    assert evaluations(runs["local-1"]) == evaluations(runs[other])


def test_tables_carry_the_config_hash(runs):
    metadata = pq.read_schema(runs["local-1"] / "parameters.parquet").metadata
    assert len(metadata[b"cluster_est.config_hash"]) == 64
