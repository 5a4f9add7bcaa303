"""The league's models that are linear in their parameters: fits against a regression by numpy."""

import tomllib

import numpy as np
import pytest
from measured_league.cases import all_cases, textbook_config
from support.measured import PLACES, measured

import cluster_est as ce
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
