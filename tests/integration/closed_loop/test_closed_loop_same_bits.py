"""Where and on how many workers a loop is closed changes no bit of what it says."""

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
LIBRARY = ['closed_loop.effects=["coulomb", "cubic", "table", "lag"]', "closed_loop.sites=[]"]
WORKERS = {
    "2 threads": ["executor.workers=2"],
    "2 of Ray": ["executor.name=ray", "executor.workers=2"],
}
PROCESSES = {
    "another hash, 2 threads in BLAS": {"PYTHONHASHSEED": "2", "OPENBLAS_NUM_THREADS": "2"}
}
TIMED = ("checksum", "seconds", "started")
"""What of run.json may differ."""


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    return write_config(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def alone(config, tmp_path_factory) -> Path:
    """The run folder of one worker."""
    run = tmp_path_factory.mktemp("runs") / "run"
    assert main(arguments(config, run)) == 0
    return run


@pytest.fixture(
    scope="module",
    params=[
        "2 threads",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("2 of Ray", *PROCESSES)),
    ],
)
def other(request, config, tmp_path_factory) -> Path:
    """The same with other workers here, or in a process of another kind."""
    run = tmp_path_factory.mktemp("runs") / "run"
    if request.param in WORKERS:
        assert main(arguments(config, run, *WORKERS[request.param])) == 0
        return run
    code = "import sys; from cluster_est.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *arguments(config, run)]
    environment = os.environ | PROCESSES[request.param]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return run


def arguments(config: Path, run: Path, *overrides: str) -> list[str]:
    return ["close-loop", str(config), "--out", str(run), *LIBRARY, *overrides]


def said(run: Path) -> str:
    """All of run.json but its times; as text, because no NaN equals itself."""
    facts = json.loads((run / "run.json").read_text())
    return json.dumps({key: value for key, value in facts.items() if key not in TIMED})


def evaluations(run: Path) -> list[dict]:
    """What was simulated and came out, in an order that does not depend on arrival."""
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values", "residuals_hash"]
    table = read_log(run / "evaluations").select([*columns, "effects", "status"])
    return table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()


def test_it_found_something(alone):
    facts = json.loads((alone / "run.json").read_text())
    (effect,) = facts["effects"]
    assert (facts["verdict"], effect["form"]) == ("found", "coulomb")


def test_all_that_is_said_is_the_same(alone, other):
    assert said(alone) == said(other)


@pytest.mark.parametrize("table", TABLES)
def test_tables_are_byte_identical(alone, other, table):
    first, second = (run / f"{table}.parquet" for run in (alone, other))
    assert first.read_bytes() == second.read_bytes()


def test_evaluations_are_identical(alone, other):
    assert evaluations(alone) == evaluations(other)


@pytest.mark.slow
def test_another_seed_finds_the_same_effect(config, alone, tmp_path):
    """Its Monte-Carlo draws are others, so a p-value may differ; what is missing may not."""
    assert main(arguments(config, tmp_path / "run", "closed_loop.seed=5")) == 0
    folders = alone, tmp_path / "run"
    one, other = (json.loads((folder / "run.json").read_text()) for folder in folders)
    assert (one["seed"], other["seed"]) == (0, 5)
    assert one["verdict"] == other["verdict"]
    assert [e["form"] for e in one["effects"]] == [e["form"] for e in other["effects"]]
