"""A model without states: a motion is given, and the current that it needs is measured."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

FMU = ROOT / "configs" / "league" / "models" / "ur5e.fmu"
NOISE = 0.01
ROLES = ("train", "train", "test")
TIMES = np.arange(300) * 0.02
LAWS = {
    "coulomb": (0.3, lambda speed: 0.3 * np.sign(speed)),
    "quadratic": (0.2, lambda speed: 0.2 * speed * np.abs(speed)),
}


def measured(law, interface="model_exchange") -> ce.Problem:
    """Three motions, each of three waves, and the current of a joint with this friction."""
    random = np.random.default_rng(3)
    runs = []
    for name, role in zip("abc", ROLES, strict=True):
        rates = np.array([0.7, 1.9, 3.1]) * random.uniform(0.8, 1.2, 3)
        waves = np.outer(TIMES, rates) + random.uniform(0.0, 6.0, 3)
        sizes = np.array([1.0, 0.5, 0.3])
        speed, turning = np.sin(waves) @ sizes, np.cos(waves) @ (sizes * rates)
        current = 0.2 * turning + 0.15 * speed + law(speed)
        current += NOISE * random.normal(size=len(TIMES))
        inputs = (ce.Input("qd", TIMES, speed), ce.Input("qdd", TIMES, turning))
        outputs = (ce.Output("i", TIMES, current, sigma=NOISE),)
        runs.append(ce.Experiment(name, 0.0, float(TIMES[-1]), inputs, outputs, role=role))
    parameters = tuple(ce.Parameter(name, 0.1, 0.0, 5.0) for name in ("J", "Fv"))
    solver = ce.Solver("fmu" if interface == "co_simulation" else "dormand_prince")
    model = ce.Model(FMU.name, FMU.read_bytes(), interface, solver, ("J", "Fv"))
    return ce.Problem(model, parameters, tuple(runs))


@pytest.mark.parametrize("form", LAWS)
def test_a_term_that_its_balance_lacks_has_its_own_name(form):
    size, law = LAWS[form]
    result = ce.close_loop(measured(law))
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    assert (effect.site, effect.form, effect.variables) == ("output i", form, ("qd",))
    assert effect.coefficients[0].value == pytest.approx(size, rel=0.03)
    assert result.rms("test", "after") < 1.1


def test_in_co_simulation_the_outputs_say_on_which_inputs_they_depend():
    """What grows with the square of a speed is a friction that grows with the speed, too."""
    result = ce.close_loop(measured(LAWS["quadratic"][1], "co_simulation"))
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    named = {(effect.site, effect.form), *((a.site, a.form) for a in effect.alternatives)}
    assert {("output i", "quadratic"), ("parameter Fv", "magnitude")} <= named
    assert result.rms("test", "after") < 1.1


def test_nothing_is_found_where_nothing_is_missing():
    result = ce.close_loop(measured(lambda speed: 0.0 * speed))
    assert result.verdict == Verdict.NONE
