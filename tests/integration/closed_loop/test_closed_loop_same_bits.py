"""Where and on how many workers a loop is closed changes no bit of what it says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.truth.springs_with_friction import write_config

from cluster_est.cli import main
from cluster_est.run_folder.evaluation_log import read_log

TABLES = ("parameters", "errors", "effects", "findings", "residuals", "trajectories")
WHOLE_LIBRARY = ["closed_loop.effects=[]", "closed_loop.sites=[]"]
WORKERS = {
    "1 worker": [],
    "2 threads": ["executor.workers=2"],
    "2 of Ray": ["executor.name=ray", "executor.workers=2"],
}
PROCESSES = {
    "another hash, 2 threads in BLAS": {"PYTHONHASHSEED": "2", "OPENBLAS_NUM_THREADS": "2"},
}
TIMED = ("seconds", "started")
"""What of run.json may differ."""


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    return write_config(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def runs(config, tmp_path_factory) -> dict[str, Path]:
    """One run folder for each way to run it: other workers here, other processes there."""
    folder = tmp_path_factory.mktemp("runs")
    for name, overrides in WORKERS.items():
        assert main(arguments(config, folder / name, *overrides)) == 0
    code = "import sys; from cluster_est.cli import main; sys.exit(main(sys.argv[1:]))"
    for name, environment in PROCESSES.items():
        command = [sys.executable, "-c", code, *arguments(config, folder / name)]
        subprocess.run(command, env=os.environ | environment, check=True, capture_output=True)
    return {name: folder / name for name in (*WORKERS, *PROCESSES)}


def arguments(config: Path, run: Path, *overrides: str) -> list[str]:
    return ["close-loop", str(config), "--out", str(run), *WHOLE_LIBRARY, *overrides]


def said(run: Path) -> str:
    """All of run.json but its times; as text, because no NaN equals itself."""
    facts = json.loads((run / "run.json").read_text())
    return json.dumps({key: value for key, value in facts.items() if key not in TIMED})


def evaluations(run: Path) -> list[dict]:
    """What was simulated and came out, in an order that does not depend on arrival."""
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values", "residuals_hash"]
    table = read_log(run / "evaluations").select([*columns, "effects", "status"])
    return table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()


def test_it_found_something(runs):
    facts = json.loads((runs["1 worker"] / "run.json").read_text())
    (effect,) = facts["effects"]
    assert (facts["verdict"], effect["form"]) == ("found", "coulomb")


@pytest.mark.parametrize("other", [*WORKERS, *PROCESSES][1:])
def test_all_that_is_said_is_the_same(runs, other):
    assert said(runs["1 worker"]) == said(runs[other])


@pytest.mark.parametrize("other", [*WORKERS, *PROCESSES][1:])
@pytest.mark.parametrize("table", TABLES)
def test_tables_are_byte_identical(runs, table, other):
    first, second = (runs[name] / f"{table}.parquet" for name in ("1 worker", other))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("other", [*WORKERS, *PROCESSES][1:])
def test_evaluations_are_identical(runs, other):
    assert evaluations(runs["1 worker"]) == evaluations(runs[other])


def test_another_seed_finds_the_same_effect(config, runs, tmp_path):
    """Its Monte-Carlo draws are others, so a p-value may differ; what is missing may not."""
    assert main(arguments(config, tmp_path / "run", "closed_loop.seed=5")) == 0
    folders = runs["1 worker"], tmp_path / "run"
    one, other = (json.loads((folder / "run.json").read_text()) for folder in folders)
    assert (one["seed"], other["seed"]) == (0, 5)
    assert one["verdict"] == other["verdict"]
    assert [e["form"] for e in one["effects"]] == [e["form"] for e in other["effects"]]
