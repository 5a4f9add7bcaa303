"""Measured systems: what a base model leaves, and what a named effect makes of it.

The league's models that are linear in their parameters are compared with a regression by numpy,
the cascaded tanks with SciPy from the shell's entry point to the tables. What the base models of
the Silverbox and of EMPS leave is said in `test_measured_closed_loops.py`.
"""

import tomllib

import numpy as np
import pytest
from measured_league.cases import all_cases, textbook_config
from scipy.integrate import solve_ivp
from support.measured import PLACES, measured
from support.problems.seen_springs import values_of
from support.problems.springs import ROOT
from support.run_folders import rows

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.config.reader import parse_config

CASES = {case.name: case for case in all_cases()}


def table(file: str):
    return np.genfromtxt(measured(file), delimiter=",", names=True)


def errors(name: str, monkeypatch: pytest.MonkeyPatch, *, textbook: bool = False):
    """The root mean square errors of a fit, by the role of its single experiment."""
    case = CASES[name]
    text = textbook_config(case) if textbook else case.config.read_text(encoding="utf-8")
    folder = next(p for p in PLACES if (p / "league" / name).is_dir())
    monkeypatch.setenv("CLUSTER_EST_DATA", str(folder))
    config = parse_config(tomllib.loads(text), name)
    fitted = ce.fit(ce.build_problem(config, case.config.parent))
    return {each.role: each.rmse_after for each in fitted.errors}


def regressed(columns, measured_values, train, test):
    """The same by linear regression on the rows that train."""
    matrix = np.stack(columns, axis=1)
    found = np.linalg.lstsq(matrix[train], measured_values[train], rcond=None)[0]
    left = measured_values - matrix @ found
    return {
        role: np.sqrt(np.mean(left[rows] ** 2)) for role, rows in (("train", train), ("test", test))
    }


@pytest.mark.slow
def test_rocket_without_air(monkeypatch):
    data = table("league/rocket/flight.csv")
    time = data["time"] - 4.5
    expected = regressed(
        [np.ones_like(time), time],
        data["alt"] + 0.5 * 9.81 * time**2,
        (data["time"] >= 4.5) & (data["time"] < 16.0),
        (data["time"] >= 16.0) & (data["time"] <= 23.5),
    )
    assert errors("rocket", monkeypatch) == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("textbook", [False, True])
def test_wrist_with_and_without_dry_friction(monkeypatch, textbook):
    data = table("league/ur5e/moves.csv")
    speed = data["qd5"]
    moving = np.abs(speed) > 0.01
    columns = [data["qdd_target5"], speed, *([np.sign(speed)] if textbook else [])]
    early = data["time"] < 15.0
    expected = regressed(columns, data["i5"], moving & ~early, moving & early)
    found = errors("ur5e", monkeypatch, textbook=textbook)
    assert found == pytest.approx(expected, rel=1e-5)


FILE = "cascaded_tanks/dataBenchmark.csv"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    measured(FILE)
    folder = tmp_path_factory.mktemp("tanks") / "run"
    config = ROOT / "configs" / "cascaded_tanks.toml"
    assert main(["fit", str(config), "--out", str(folder)]) == 0
    return folder


def test_base_model_reaches_its_error_on_the_test_record_which_took_no_part(run):
    errors = {row["experiment"]: row for row in rows(run, "errors")}
    assert errors["Val"]["role"] == "test"
    assert errors["Est"]["rmse_after"] < 0.61
    assert errors["Val"]["rmse_after"] < 0.70
    assert errors["Est"]["rmse_before"] > 2.0
    assert {row["estimated_on"] for row in rows(run, "parameters")} == {"train"}


def test_simulated_levels_are_those_of_scipy(run):
    """The reported curve, on equations written down again, for the first 100 samples."""
    values = values_of(run)
    found = rows(run, "residuals")
    simulated = [row["simulated"] for row in found if row["experiment"] == "Est"][:100]
    pump = np.genfromtxt(measured(FILE), delimiter=",", skip_header=1, usecols=0)
    levels, lower = np.array([values["h1"], values["h2"]]), [values["h2"]]
    for k in range(99):

        def slope(t, h, u=pump[k]):
            flow = values["k1"] * np.sqrt(max(h[0], 0.0))
            return [values["kp"] * u - flow, flow - values["k2"] * np.sqrt(max(h[1], 0.0))]

        step = solve_ivp(slope, (0.0, 4.0), levels, rtol=1e-11, atol=1e-12)
        levels = step.y[:, -1]
        lower.append(levels[1])
    np.testing.assert_allclose(simulated, lower, rtol=1e-7)
