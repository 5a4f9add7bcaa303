"""The measured EMPS: viscous friction alone, and what a named Coulomb friction makes of it."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from scipy.io import loadmat
from support.measured import measured
from support.problems.springs import ROOT

from cluster_est import build_problem, fit
from cluster_est.config.reader import parse_config

FILES = {"no pulses": "emps/DATA_EMPS.mat", "pulses": "emps/DATA_EMPS_PULSES.mat"}
COULOMB = {
    "name": "coulomb",
    "site": "der(v)",
    "form": "coulomb",
    "parameters": {"k": {"start": 0.05}, "width": {"start": 1e-3, "fixed": True}},
}


def force_norm(experiment: str) -> float:
    """The root mean square of the measured force, from the file itself."""
    data = loadmat(measured(FILES[experiment]), squeeze_me=True)
    return float(data["gtau"] * np.sqrt(np.mean(data["vir"] ** 2)))


@pytest.mark.parametrize(
    ("effects", "training", "pulses"),
    [([], (0.165, 0.180), (0.160, 0.175)), ([COULOMB], (0.035, 0.050), (0.045, 0.065))],
)
def test_relative_error_of_the_force(effects, training, pulses):
    norms = {experiment: force_norm(experiment) for experiment in FILES}
    path = ROOT / "configs" / "emps.toml"
    raw = tomllib.loads(path.read_text(encoding="utf-8")) | {"effects": effects}
    result = fit(build_problem(parse_config(raw, "emps"), path.parent))
    errors = {e.experiment: e.rmse_after / norms[e.experiment] for e in result.errors}
    assert training[0] <= errors["no pulses"] <= training[1]
    assert pulses[0] <= errors["pulses"] <= pulses[1]
