"""The measured Silverbox: a linear base model, and what a named cubic stiffness makes of it."""

from __future__ import annotations

import tomllib

import pytest
from support.measured import measured
from support.problems.springs import ROOT

from cluster_est import build_problem, fit
from cluster_est.config.reader import parse_config

CUBIC = {
    "name": "cubic",
    "site": "der(v)",
    "equation": "-a * y^3",
    "parameters": {"a": {"start": 0.0, "neutral": 0.0}},
}


@pytest.mark.parametrize(
    ("effects", "least", "most"), [([], 0.0130, 0.0145), ([CUBIC], 0.0, 0.0010)]
)
def test_error_on_the_arrow(effects, least, most):
    measured("silverbox/SNLS80mV.csv")
    path = ROOT / "configs" / "silverbox.toml"
    raw = tomllib.loads(path.read_text(encoding="utf-8")) | {"effects": effects}
    result = fit(build_problem(parse_config(raw, "silverbox"), path.parent))
    (arrow,) = [e for e in result.errors if e.experiment == "arrow"]
    assert least <= arrow.rmse_after <= most
