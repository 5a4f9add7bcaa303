"""A posterior of a run: its draws, the bands that it predicts, and what is said without one.

That it is drawn with the same bits everywhere is tested for every kind of run.
"""

from pathlib import Path

import numpy as np
import pytest
from support.run_folders import SPRING, facts, rows

import cluster_est as ce
from cluster_est.cli import main

SHORT = ["experiment_defaults.sigma.y=0.002", "uncertainty.posterior=40"]


def fit(folder: Path, *arguments: str) -> Path:
    assert main(["fit", SPRING, "--out", str(folder), *SHORT, *arguments]) in (0, 1)
    return folder


@pytest.fixture(scope="module")
def usual(tmp_path_factory) -> Path:
    return fit(tmp_path_factory.mktemp("posterior") / "run")


@pytest.mark.slow
def test_every_draw_is_a_row_and_what_has_not_mixed_has_no_interval(usual):
    draws = rows(usual, "posterior")
    assert {row["label"] for row in draws} == {"m", "k", "c", "x0[exp5]"}
    assert {row["walker"] for row in draws} == set(range(16))
    values = [row["value"] for row in draws if row["label"] == "m"]
    assert np.mean(values) == pytest.approx(1.2, abs=2e-3)
    assert not (usual / "intervals.parquet").exists()
    (said,) = [note for note in facts(usual)["notes"] if note.startswith("posterior: 16 walkers")]
    assert "no interval, because" in said


def test_a_posterior_predicts_bands_that_the_report_draws(tmp_path):
    """Of one unknown whose posterior is narrow, so that the band is its slope times its error."""
    held = [f"parameters.{name}.fixed=true" for name in ("k", "c", "x0")]
    found = {"k": 30.0, "c": 0.6, "x0": 0.15}
    starts = [f"parameters.{name}.start={value}" for name, value in found.items()]
    many = "uncertainty.posterior=250", "uncertainty.walkers=8"
    folder = fit(tmp_path / "run", *held, *starts, *many)
    (own,) = [row for row in rows(folder, "intervals") if row["source"] == "posterior"]
    bands = rows(folder, "predictions")
    assert {row["experiment"] for row in bands} == {f"exp{i}" for i in range(1, 6)}
    assert {row["role"] for row in bands} == {"train", "test"}
    assert all(row["lower"] <= row["median"] <= row["upper"] for row in bands)
    problem = ce.read_problem(SPRING)
    ends = []
    for mass in (own["lower"], own["upper"]):
        simulations = ce.simulate(problem, values={"m": mass, "k": 30.0, "c": 0.6})
        trajectory = simulations[0].outcome.trajectory
        assert trajectory is not None
        ends.append(np.interp(problem.experiments[0].outputs[0].times, trajectory.times,
                              trajectory.values[:, trajectory.variables.index("y")]))  # fmt: skip
    first = [row for row in bands if row["experiment"] == "exp1"]
    widths = np.array([row["upper"] - row["lower"] for row in first])
    expected = np.abs(ends[1] - ends[0])
    assert np.linalg.norm(widths) == pytest.approx(np.linalg.norm(expected), rel=0.25)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "where the output lies by the posterior of the values" in page
    assert 'class="band after"' in page


def test_a_budget_that_ends_it_leaves_no_draws_and_says_so(tmp_path):
    folder = fit(tmp_path / "run", "budget.evaluations=300", "--no-report")
    assert not (folder / "posterior.parquet").exists()
    (said,) = [note for note in facts(folder)["notes"] if note.startswith("posterior:")]
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
    assert main(["fit", SPRING, "--out", str(tmp_path / "run"), *SHORT, given]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
