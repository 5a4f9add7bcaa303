"""A posterior of a run: the same bits wherever it is drawn, taken up again, and cut short."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.cli import main

CONFIG = str(ROOT / "configs" / "mass_spring_damper.toml")
SHORT = ["experiment_defaults.sigma.y=0.002", "uncertainty.posterior=40"]


def fit(folder: Path, *arguments: str) -> dict[str, object]:
    assert main(["fit", CONFIG, "--out", str(folder), *SHORT, *arguments]) in (0, 1)
    facts: dict[str, object] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return facts


def draws(folder: Path) -> list[dict[str, object]]:
    return pq.read_table(folder / "posterior.parquet").to_pylist()


@pytest.fixture(scope="module")
def usual(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("posterior") / "run"
    fit(folder)
    return folder


def test_every_draw_is_a_row_and_what_has_not_mixed_has_no_interval(usual):
    rows = draws(usual)
    labels = {row["label"] for row in rows}
    assert labels == {"m", "k", "c", "x0[exp5]"}
    assert {row["walker"] for row in rows} == set(range(16))
    values = [row["value"] for row in rows if row["label"] == "m"]
    assert np.mean(values) == pytest.approx(1.2, abs=2e-3)
    assert not (usual / "intervals.parquet").exists()
    facts = json.loads((usual / "run.json").read_text(encoding="utf-8"))
    (said,) = [note for note in facts["notes"] if note.startswith("posterior: 16 walkers")]
    assert "no interval, because" in said


def test_a_posterior_predicts_bands_that_the_report_draws(tmp_path):
    """Of one unknown whose posterior is narrow, so that the band is its slope times its error."""
    folder = tmp_path / "run"
    held = [f"parameters.{name}.fixed=true" for name in ("k", "c", "x0")]
    found = {"k": 30.0, "c": 0.6, "x0": 0.15}
    starts = [f"parameters.{name}.start={value}" for name, value in found.items()]
    fit(folder, *held, *starts, "uncertainty.posterior=500", "uncertainty.walkers=8")
    intervals = pq.read_table(folder / "intervals.parquet").to_pylist()
    (own,) = [row for row in intervals if row["source"] == "posterior"]
    rows = pq.read_table(folder / "predictions.parquet").to_pylist()
    assert {row["experiment"] for row in rows} == {f"exp{i}" for i in range(1, 6)}
    assert {row["role"] for row in rows} == {"train", "test"}
    assert all(row["lower"] <= row["median"] <= row["upper"] for row in rows)
    problem = ce.read_problem(CONFIG)
    ends = []
    for mass in (own["lower"], own["upper"]):
        simulations = ce.simulate(problem, values={"m": mass, "k": 30.0, "c": 0.6})
        trajectory = simulations[0].outcome.trajectory
        assert trajectory is not None
        ends.append(np.interp(problem.experiments[0].outputs[0].times, trajectory.times,
                              trajectory.values[:, trajectory.variables.index("y")]))  # fmt: skip
    first = [row for row in rows if row["experiment"] == "exp1"]
    widths = np.array([row["upper"] - row["lower"] for row in first])
    expected = np.abs(ends[1] - ends[0])
    assert np.linalg.norm(widths) == pytest.approx(np.linalg.norm(expected), rel=0.25)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "where the output lies by the posterior of the values" in page
    assert 'class="band after"' in page


def test_two_processes_draw_the_same_bits(usual, tmp_path):
    fit(tmp_path / "run", "executor.name=processes", "executor.workers=2")
    assert draws(tmp_path / "run") == draws(usual)


def test_a_run_that_is_taken_up_again_draws_the_same_bits_and_simulates_nothing(usual, tmp_path):
    run = tmp_path / "run"
    fit(run)
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    facts |= {"status": "running", "verdict": None}
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    fit(run, "--resume")
    assert draws(run) == draws(usual)


def test_a_budget_that_ends_it_leaves_no_draws_and_says_so(tmp_path):
    facts = fit(tmp_path / "run", "budget.evaluations=300")
    assert not (tmp_path / "run" / "posterior.parquet").exists()
    notes = facts["notes"]
    assert isinstance(notes, list)
    (said,) = [note for note in notes if note.startswith("posterior:")]
    assert said.startswith("posterior: there are no draws, because it was cut short after ")
    assert said.endswith(" of 40 steps")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("experiment_defaults.sigma={}", "sigma.y is missing; uncertainty.posterior makes"),
        ("cost.name=huber", 'uncertainty.posterior: must go with the cost "sse" or "likelihood"'),
        ("parameters.m.bounds=[0.1, inf]", "parameters.m: must have finite bounds or a prior"),
        ("uncertainty.walkers=5", "uncertainty.walkers: must be at least 8"),
    ],
)
def test_a_mistake_is_met_with_a_sentence(given, said, tmp_path, capsys):
    out = str(tmp_path / "run")
    assert main(["fit", CONFIG, "--out", out, *SHORT, given]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
