import re
from pathlib import Path

import numpy as np
import pytest
from support.problems.seen_springs import values_of
from support.problems.springs import ROOT
from support.run_folders import SPRING, facts, rows

import cluster_est as ce
from cluster_est.cli import main

SIGMA = "experiment_defaults.sigma.y=0.002"
PRIORS = [
    "parameters.m.prior={name='normal', mean=1.21, sd=0.003}",
    "parameters.c.prior={name='lognormal', median=0.6, factor=1.2}",
    "parameters.x0.prior={name='normal', mean=0.0, sd=0.1}",
]
METHODS = {
    "sensitivities": ["method.options.differences=sensitivities"],
    "sqp": ["method.name=sqp"],
    "pattern_search": ["method.name=pattern_search", "method.options.mesh_tolerance=1e-7"],
}
DRAWN = "uncertainty.posterior=40"


def fitted(folder: Path, *arguments: str) -> Path:
    """The run of a fit in a folder."""
    assert main(["fit", SPRING, "--out", str(folder / "run"), SIGMA, *arguments]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def usual(tmp_path_factory) -> Path:
    return fitted(tmp_path_factory.mktemp("usual"), *PRIORS)


def test_a_fit_says_what_its_priors_cost_and_which_of_them_it_contradicts(usual):
    cost, notes = (facts(usual)[key] for key in ("cost", "notes"))
    assert values_of(usual)["m"] == pytest.approx(1.2, abs=1e-3)  # which the measurements say
    (added,) = [note for note in notes if "priors" in note]
    found = re.search(r"3 priors, which count like measurements, add ([\d.]+)", added)
    assert 4.0 < float(found[1]) < cost
    (far,) = [note for note in notes if "its prior" in note]
    assert re.search(r"m = 1.2 lies 3.4 standard deviations below .*normal, 1.21 . 0.003", far)


@pytest.mark.parametrize(
    "method",
    [pytest.param(m, marks=pytest.mark.slow if m == "pattern_search" else ()) for m in METHODS],
)
def test_every_method_finds_the_same_minimum(method, usual, tmp_path):
    run = fitted(tmp_path, *PRIORS, *METHODS[method])
    values = values_of(run)
    assert facts(run)["cost"] == pytest.approx(facts(usual)["cost"], rel=1e-5)
    for label, value in values_of(usual).items():
        assert values[label] == pytest.approx(value, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("{mean=1.0, sd=0.1}", r"prior\.name: must be one of normal, lognormal .*missing"),
        ("{name='norml', mean=1.0, sd=0.1}", r"prior\.name: must be one of .*'norml'"),
        ("{name='normal', mean=1.0}", r"prior\.sd is missing"),
        ("{name='normal', mean=1.0, sd='1'}", r"prior\.sd: must be a number, but is '1'"),
        ("{name='normal', mean=1.0, sd=0.1, bias=2}", r"prior\.bias: normal has no such option"),
        (
            "{name='normal', mean=20.0, sd=0.1}",
            r"prior: must have its centre within the bounds .0.1, 10",
        ),
        ("experiment_defaults.sigma={}", r"sigma\.y is missing, but uncertainty\.posterior needs"),
        (
            "cost.name=huber",
            r'uncertainty\.posterior: must be used with the cost "sse" or "likelihood"',
        ),
        ("parameters.m.bounds=[0.1, inf]", r"parameters\.m: must have finite bounds or a prior"),
        ("uncertainty.walkers=5", r"uncertainty\.walkers: must be at least 8"),
    ],
)
def test_a_mistake_is_met_with_a_sentence(given, said, tmp_path, capsys):
    more = [DRAWN]
    if given.startswith("{"):
        given, said, more = f"parameters.m.prior={given}", rf"parameters\.m\.{said}", PRIORS
    assert main(["fit", SPRING, "--out", str(tmp_path / "run"), SIGMA, *more, given]) == 2
    error = capsys.readouterr().err
    assert re.search(said, error)
    assert "Traceback" not in error


def test_the_closed_loop_does_not_take_a_prior_for_a_measurement(tmp_path, capsys):
    out = str(tmp_path / "run")
    assert main(["close-loop", SPRING, "--out", out, SIGMA, *PRIORS]) == 2
    assert "parameters.m.prior must not be used, because the tests" in capsys.readouterr().err


def test_a_coefficient_of_an_effect_is_drawn_to_its_prior(tmp_path):
    """By as much as two measurements with these standard errors are worth."""
    friction = str(ROOT / "configs" / "mass_with_friction.toml")
    found = {}
    for name, prior in (("free", ""), ("drawn", ", prior={name='normal', mean=0.51, sd=0.0005}")):
        effect = (
            "effects=[{form='coulomb', site='der(v)', "
            f"parameters={{k={{start=0.4{prior}}}, width={{start=0.002, fixed=true}}}}}}]"
        )
        out = tmp_path / name
        assert main(["fit", friction, "--out", str(out), SIGMA, effect, "--no-report"]) == 0
        found[name] = next(r for r in rows(out, "parameters") if r["parameter"] == "coulomb.k")
    free, drawn = found["free"], found["drawn"]
    # which the standard error has, and the fit has not
    scatter = facts(tmp_path / "free")["rmse_over_sigma"]["train"]
    measured, known = (scatter / free["std_error"]) ** 2, 0.0005**-2
    expected = (measured * free["value"] + known * 0.51) / (measured + known)
    assert drawn["value"] == pytest.approx(expected, abs=0.3 * free["std_error"])
    assert drawn["std_error"] < free["std_error"]


@pytest.mark.slow
def test_every_draw_is_a_row_and_what_has_not_mixed_has_no_interval(tmp_path):
    run = fitted(tmp_path, DRAWN)
    draws = rows(run, "posterior")
    assert {row["label"] for row in draws} == {"m", "k", "c", "x0[exp5]"}
    assert {row["walker"] for row in draws} == set(range(16))
    values = [row["value"] for row in draws if row["label"] == "m"]
    assert np.mean(values) == pytest.approx(1.2, abs=2e-3)
    assert not (run / "intervals.parquet").exists()
    (said,) = [note for note in facts(run)["notes"] if note.startswith("posterior: 16 walkers")]
    assert "no interval, because" in said


def test_a_posterior_predicts_bands_that_the_report_draws(tmp_path):
    """Of one unknown whose posterior is narrow, so that the band is its slope times its error."""
    held = [f"parameters.{name}.fixed=true" for name in ("k", "c", "x0")]
    found = {"k": 30.0, "c": 0.6, "x0": 0.15}
    starts = [f"parameters.{name}.start={value}" for name, value in found.items()]
    many = "uncertainty.posterior=250", "uncertainty.walkers=8"
    folder = fitted(tmp_path, *held, *starts, *many)
    (own,) = [row for row in rows(folder, "intervals") if row["source"] == "posterior"]
    bands = rows(folder, "predictions")
    assert {row["experiment"] for row in bands} == {f"exp{i}" for i in range(1, 6)}
    assert {row["role"] for row in bands} == {"train", "test"}
    assert all(row["lower"] <= row["median"] <= row["upper"] for row in bands)
    problem = ce.read_problem(SPRING)
    ends = []
    for mass in (own["lower"], own["upper"]):
        simulations = ce.simulate(problem, values={"m": mass, "k": 30.0, "c": 0.6})
        trajectory = simulations["exp1"].outcome.trajectory
        assert trajectory is not None
        ends.append(np.interp(problem.experiments[0].outputs[0].times, trajectory.times,
                              trajectory.values[:, trajectory.variables.index("y")]))  # fmt: skip
    first = [row for row in bands if row["experiment"] == "exp1"]
    widths = np.array([row["upper"] - row["lower"] for row in first])
    expected = np.abs(ends[1] - ends[0])
    assert np.linalg.norm(widths) == pytest.approx(np.linalg.norm(expected), rel=0.25)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "the output for parameter values from the posterior" in page
    assert 'class="band after"' in page


def test_a_budget_that_ends_it_leaves_no_draws_and_says_so(tmp_path):
    folder = fitted(tmp_path, DRAWN, "budget.evaluations=300", "--no-report")
    assert not (folder / "posterior.parquet").exists()
    (said,) = [note for note in facts(folder)["notes"] if note.startswith("posterior:")]
    assert said.startswith("posterior: there are no draws, because sampling was stopped after ")
    assert said.endswith(" of 40 steps")
