"""The block of `[[effects]]` that a closed loop prints, read back, is the same effect."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.named_effects import estimate
from support.problems.springs import ROOT
from support.thinning import thinned

from cluster_est import Parameter, Problem, read_problem, simulate
from cluster_est.closed_loop.findings.effects import NamedEffect, config_block, effect_block
from cluster_est.results.fit_tables import Estimate, coefficient_units
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


def estimates_of(problem: Problem, fitted: list[Parameter]) -> tuple[Estimate, ...]:
    """The coefficients as a loop reports them, each with its unit."""
    units = coefficient_units(problem)
    return tuple(
        replace(
            estimate(p.name.removeprefix("e."), p.start, units[p.name]),
            lower=p.lower, upper=p.upper, scale=p.scale,
            estimated_on="known" if p.fixed else "train",
        )
        for p in fitted
    )  # fmt: skip


def read_with(text: str, block: str, folder: Path) -> Problem:
    pasted = folder / "pasted.toml"
    pasted.write_text(f"{text}\n{block}", encoding="utf-8")
    return read_problem(pasted)


def values_of(problem: Problem) -> list[tuple[object, ...]]:
    return [(p.name, p.start, p.lower, p.upper, p.scale, p.fixed) for p in problem.parameters]


@pytest.mark.parametrize(("kind", "name"), thinned([*FORMS], lambda kind, name: kind))
def test_every_form_is_read_back_from_its_block(base, kind, name, tmp_path):
    form = FORMS[kind, name]
    variables = ARGUMENTS[kind == "output"][: form.variables]
    if form.variables == 1 and kind == "pair":
        variables = ("v - x",)
    effect = Effect("e", SITES[kind], name, variables)
    problem, fitted = added_to(base, effect)
    text = (ROOT / "configs" / "mass_spring_damper.toml").read_text(encoding="utf-8")
    text = text.replace('"models/', f'"{ROOT}/configs/models/')
    text = text.replace('"data/', f'"{ROOT}/configs/data/')
    printed = config_block(NamedEffect(effect, "", "", estimates_of(problem, fitted)))
    first, again = (read_with(text, b, tmp_path) for b in (effect_block(effect, fitted), printed))
    assert first.effects == again.effects
    assert values_of(first) == values_of(again)
    one, other = simulate(problem), simulate(again)
    for id_ in one:
        np.testing.assert_array_equal(one[id_].to_frame()["y"], other[id_].to_frame()["y"])
