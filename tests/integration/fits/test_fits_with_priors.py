"""Fits with priors from a config: every method, both kinds of derivatives, and what is said."""

import json
import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.problems.seen_springs import values_of
from support.problems.springs import ROOT

from cluster_est.cli import main

CONFIG = str(ROOT / "configs" / "mass_spring_damper.toml")
PRIORS = [
    "experiment_defaults.sigma.y=0.002",
    "parameters.m.prior={name='normal', mean=1.21, sd=0.003}",
    "parameters.c.prior={name='lognormal', median=0.6, factor=1.2}",
    "parameters.x0.prior={name='normal', mean=0.0, sd=0.1}",
]
METHODS = {
    "sensitivities": ["method.options.differences=sensitivities"],
    "sqp": ["method.name=sqp"],
    "pattern_search": ["method.name=pattern_search", "method.options.mesh_tolerance=1e-7"],
}


def fitted(folder: Path, *arguments: str) -> tuple[dict[str, float], float, list[str]]:
    assert main(["fit", CONFIG, "--out", str(folder), *PRIORS, *arguments]) == 0
    facts = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return values_of(folder), facts["cost"], facts["notes"]


@pytest.fixture(scope="module")
def usual(tmp_path_factory) -> tuple[dict[str, float], float, list[str]]:
    return fitted(tmp_path_factory.mktemp("usual") / "run")


def test_a_fit_says_what_its_priors_cost_and_which_of_them_it_contradicts(usual):
    values, cost, notes = usual
    assert values["m"] == pytest.approx(1.2, abs=1e-3)  # which the measurements say
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
    values, cost, _ = fitted(tmp_path / "run", *METHODS[method])
    assert cost == pytest.approx(usual[1], rel=1e-5)
    for label, value in usual[0].items():
        assert values[label] == pytest.approx(value, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("{mean=1.0, sd=0.1}", r"prior\.name: must be one of normal, lognormal .*missing"),
        ("{name='norml', mean=1.0, sd=0.1}", r"prior\.name: must be one of .*'norml'"),
        ("{name='normal', mean=1.0}", r"prior\.sd is missing"),
        ("{name='normal', mean=1.0, sd='1'}", r"prior\.sd: must be a number but is '1'"),
        ("{name='normal', mean=1.0, sd=0.1, bias=2}", r"prior\.bias: normal has no such option"),
        (
            "{name='normal', mean=20.0, sd=0.1}",
            r"prior: must have its centre within the bounds .0.1, 10",
        ),
    ],
)
def test_a_wrong_prior_is_met_with_a_sentence(given, said, tmp_path, capsys):
    given = f"parameters.m.prior={given}"
    assert main(["fit", CONFIG, "--out", str(tmp_path / "run"), *PRIORS, given]) == 2
    error = capsys.readouterr().err
    assert re.search(rf"parameters\.m\.{said}", error)
    assert "Traceback" not in error


def test_the_closed_loop_does_not_take_a_prior_for_a_measurement(tmp_path, capsys):
    out = str(tmp_path / "run")
    assert main(["close-loop", CONFIG, "--out", out, *PRIORS]) == 2
    assert "parameters.m.prior must be left out, because its tests" in capsys.readouterr().err


def test_a_coefficient_of_an_effect_is_drawn_to_its_prior(tmp_path):
    """By as much as two measurements with these standard errors are worth."""
    friction = str(ROOT / "configs" / "mass_with_friction.toml")
    sigma = "experiment_defaults.sigma.y=0.002"
    rows = {}
    for name, prior in (("free", ""), ("drawn", ", prior={name='normal', mean=0.51, sd=0.0005}")):
        effect = (
            "effects=[{form='coulomb', site='der(v)', "
            f"parameters={{k={{start=0.4{prior}}}, width={{start=0.002, fixed=true}}}}}}]"
        )
        out = tmp_path / name
        assert main(["fit", friction, "--out", str(out), sigma, effect, "--no-report"]) == 0
        table = pq.read_table(out / "parameters.parquet").to_pylist()
        rows[name] = next(row for row in table if row["parameter"] == "coulomb.k")
    free, drawn = rows["free"], rows["drawn"]
    facts = json.loads((tmp_path / "free" / "run.json").read_text(encoding="utf-8"))
    scatter = facts["rmse_over_sigma"]["train"]  # which the standard error has, and the fit has not
    measured, known = (scatter / free["std_error"]) ** 2, 0.0005**-2
    expected = (measured * free["value"] + known * 0.51) / (measured + known)
    assert drawn["value"] == pytest.approx(expected, abs=0.3 * free["std_error"])
    assert drawn["std_error"] < free["std_error"]
