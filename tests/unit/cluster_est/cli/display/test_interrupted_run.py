"""What is printed of a run whose last simulations were not done, and of one whose failed."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from cluster_est.cli.display.run import SHOWN, print_run
from cluster_est.run_folder.reading import StoredRun

NAN = float("nan")
PARAMETER = {
    "label": "m",
    "value": 1.0,
    "lower95": NAN,
    "upper95": NAN,
    "unit": "kg",
    "start": 1.0,
    "estimated_on": "train",
    "at_bound": "",
}
ERROR = {
    "experiment": "a",
    "role": "train",
    "output": "y",
    "samples": 10,
    "rmse_before": 0.5,
    "rmse_after": NAN,
    "unit": "m",
    "relative_after": NAN,
}
COUNTS = {"iterations": 3, "evaluations": 9, "simulations": 9, "failures": 0, "seconds": 1.0}


@pytest.fixture
def printed(tmp_path: Path):
    def call(status: str) -> str:
        for name in ("parameters", "errors"):
            (tmp_path / f"{name}.parquet").touch()
        tables = {name: [] for name in SHOWN} | {"parameters": [PARAMETER], "errors": [ERROR]}
        facts = {"status": status, "cost_before": 4.0, "cost": NAN, **COUNTS}
        out = io.StringIO()
        print_run(Console(file=out, width=200), StoredRun(tmp_path, facts, tables))
        return out.getvalue()

    return call


def test_what_was_not_simulated_did_not_fail(printed):
    said = printed("interrupted")
    assert "cost 4 -> not simulated in 3 iterations" in said
    assert "0.5          not simulated  m" in said
    assert "nan" not in said
    assert "not determined" not in said


def test_what_failed_is_said_without_a_number(printed):
    said = printed("failed")
    assert "cost 4 -> failed in 3 iterations" in said
    assert "nan" not in said
    assert "not determined" in said
