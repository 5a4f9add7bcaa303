"""The block of `[[effects]]` that a closed loop prints, read back, is the same effect."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import ROOT
from support.thinning import thinned

from cluster_est import Parameter, Problem, read_problem, simulate
from cluster_est.closed_loop.findings.effects import effect_block
from workers.effects.definition import coefficients
from workers.effects.forms import FORMS
from workers.messages import Effect

SITES = {
    "derivative": "der(v)",
    "pair": "pair v,x",
    "input": "input F",
    "output": "output y",
    "parameter": "parameter k",
}
ARGUMENTS = ("v", "F"), ("F", "v")
"""Of states, and of outputs, which may not depend on a state."""
VALUES = {"low": -1.5, "high": 1.5, "limit": 0.4, "width": 0.02, "zero": 273.15, "rate": 50.0}
"""Of coefficients of which 0.05 would be no sensible value."""


@pytest.fixture(scope="module")
def base() -> Problem:
    return read_problem(ROOT / "configs" / "mass_spring_damper.toml")


def added_to(problem: Problem, effect: Effect) -> tuple[Problem, list[Parameter]]:
    """The problem as a loop has it, and the coefficients as they were fitted."""
    fitted = []
    for each in coefficients(effect, effect.name):
        value = 1e-9 if effect.form == "radiation" else 0.05  # of a fourth power of kelvin
        if effect.form != "exponential":
            value = VALUES.get(each.name, value)
        elif each.name == "width":
            value = 2.0
        low = 0.0 if each.positive else -np.inf
        label = f"{effect.name}.{each.name}"
        fitted.append(Parameter(label, value, (low, np.inf), fixed=each.held))
    both = (*problem.parameters, *fitted)
    return replace(problem, effects=(effect,), parameters=both), fitted


@pytest.mark.parametrize(("kind", "name"), thinned([*FORMS], lambda kind, name: kind))
def test_every_form_is_read_back_from_its_block(base, kind, name, tmp_path):
    form = FORMS[kind, name]
    variables = ARGUMENTS[kind == "output"][: form.variables]
    if form.variables == 1 and kind == "pair":
        variables = ("v - x",)
    effect = Effect("added", SITES[kind], name, variables)
    problem, fitted = added_to(base, effect)
    text = (ROOT / "configs" / "mass_spring_damper.toml").read_text(encoding="utf-8")
    text = text.replace('"models/', f'"{ROOT}/configs/models/')
    text = text.replace('"data/', f'"{ROOT}/configs/data/')
    pasted = tmp_path / "pasted.toml"
    pasted.write_text(f"{text}\n{effect_block(effect, fitted)}", encoding="utf-8")
    again = read_problem(pasted)
    one, other = simulate(problem), simulate(again)
    for id_ in one:
        np.testing.assert_array_equal(one[id_].to_frame()["y"], other[id_].to_frame()["y"])
