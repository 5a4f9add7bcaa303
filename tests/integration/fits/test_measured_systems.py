"""Measured systems: what a base model leaves, and what a named effect makes of it."""

import tomllib

import numpy as np
import pytest
from scipy.io import loadmat
from support.measured import measured
from support.problems.springs import ROOT

from cluster_est import build_problem, fit
from cluster_est.config.reader import parse_config

pytestmark = pytest.mark.slow

PULSES = {"no pulses": "emps/DATA_EMPS.mat", "pulses": "emps/DATA_EMPS_PULSES.mat"}
COULOMB = {
    "name": "coulomb",
    "site": "der(v)",
    "form": "coulomb",
    "parameters": {"k": {"start": 0.05}, "width": {"start": 1e-3, "fixed": True}},
}
CUBIC = {
    "name": "cubic",
    "site": "der(v)",
    "equation": "-a * y^3",
    "parameters": {"a": {"start": 0.0, "neutral": 0.0}},
}


def errors(name: str, effects: list[dict]) -> dict[str, float]:
    """The root mean square errors of a fit, by experiment."""
    path = ROOT / "configs" / f"{name}.toml"
    raw = tomllib.loads(path.read_text(encoding="utf-8")) | {"effects": effects}
    result = fit(build_problem(parse_config(raw, name), path.parent))
    return {each.experiment: each.rmse_after for each in result.errors}


def force_norm(file: str) -> float:
    """The root mean square of the measured force, from the file itself."""
    data = loadmat(measured(file), squeeze_me=True)
    return float(data["gtau"] * np.sqrt(np.mean(data["vir"] ** 2)))


@pytest.mark.parametrize(
    ("effects", "training", "pulses"),
    [
        ([], (0.165, 0.180), (0.160, 0.175)),
        ([COULOMB], (0.035, 0.050), (0.045, 0.065)),
    ],
)
def test_relative_error_of_the_force_of_emps(effects, training, pulses):
    norms = {experiment: force_norm(file) for experiment, file in PULSES.items()}
    found = errors("emps", effects)
    assert training[0] <= found["no pulses"] / norms["no pulses"] <= training[1]
    assert pulses[0] <= found["pulses"] / norms["pulses"] <= pulses[1]


@pytest.mark.parametrize(
    ("effects", "least", "most"), [([], 0.0130, 0.0145), ([CUBIC], 0.0, 0.0010)]
)
def test_error_on_the_arrow_of_the_silverbox(effects, least, most):
    measured("silverbox/SNLS80mV.csv")
    assert least <= errors("silverbox", effects)["arrow"] <= most
