"""A few cases of the closed-loop benchmark, whose data come from equations of its own in NumPy.

No problem mentions the effect; parameters start up to a quarter off.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from closed_loop_benchmark.data import Data, make, make_problem, run_name
from closed_loop_benchmark.naming import compare, normal
from closed_loop_benchmark.oracle import translate
from closed_loop_benchmark.scenarios import all_scenarios

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

NAMES = (
    "mass_spring_damper/single/coulomb x0.25",
    "cascaded_tanks/single/overflow x0.25",
    "pendulum/single/sensor_lag x1.0",
    "pendulum/single/sensor_square x1.0",
    "dc_motor/single/dead_zone x1.0",
    "room/single/damp_wall x1.0",
    "mass_spring_damper/single/fatigue x1.0",
    "battery/single/voltage_drift x1.0",
    "pendulum/clean/0.01 0.0 0",
    "pendulum/clean/0.01 0.8 0",
    "dc_motor/clean/0.01 0.8 0",
)
"""Effects at rates, outputs, an input and parameters, one of them in co-simulation; none."""
EVERY = {case.name: case for case in all_scenarios()}
CASES = {name: EVERY[name] for name in NAMES}
COMPLETE = [name for name, case in CASES.items() if not case.effects]
LACKING = [name for name, case in CASES.items() if case.effects]
UNKNOWN = {*COMPLETE[1::2], *LACKING[1::2]}
"""Cases whose noise is not given."""
QUICK = {
    "pendulum/single/sensor_square x1.0",
    "mass_spring_damper/single/fatigue x1.0",
    "pendulum/clean/0.01 0.0 0",
    "pendulum/clean/0.01 0.8 0",
}
"""Seconds each. A friction and a dead zone are found by default in `test_close_loop.py` and small
searches."""


def each(names):
    return [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in names]


@cache
def closed(name: str) -> tuple[Data, ce.LoopResult]:
    data = make(CASES[name])
    problem = make_problem(data)
    if name in UNKNOWN:
        runs = (
            replace(run, outputs=tuple(replace(o, sigma=1.0) for o in run.outputs))
            for run in problem.experiments
        )
        problem = replace(problem, experiments=tuple(runs))
    return data, ce.close_loop(problem)


def drawn(data: Data) -> dict[tuple[str, str], float]:
    """Root mean square of the noise in each output of each run: the least that can be left."""
    return {
        (run_name(number, run), name): float(np.sqrt(np.mean(noise**2)))
        for number, run in enumerate(data.experiments)
        for name, noise in zip(data.system.outputs, (run.outputs - run.true_outputs).T, strict=True)
    }


@pytest.mark.parametrize("name", each(LACKING))
def test_an_effect_is_found_and_named_with_its_coefficients(name):
    data, result = closed(name)
    assert result.verdict == Verdict.FOUND
    (effect,), (accepted,) = result.effects, CASES[name].accepted
    called = normal(effect.form, effect.site, effect.variables)
    assert compare(accepted, [called], []).alias, called
    assert result.rejected == ()
    _, true = translate(CASES[name].effects[0], 0)
    for each in effect.coefficients:
        coefficient = each.label.rpartition(".")[2]
        if coefficient != "width":  # how sharp a friction switches is hardly seen
            assert each.value == pytest.approx(true[coefficient], rel=0.02)
    for parameter, value in data.true_parameters.items():
        assert result.after.x[parameter] == pytest.approx(value, rel=0.02)


@pytest.mark.parametrize("name", each(LACKING))
def test_errors_fall_to_the_noise_in_training_and_held_out(name):
    data, result = closed(name)
    noise, sigma = drawn(data), dict(zip(data.system.outputs, data.sigma, strict=True))
    assert len(result.errors) == len(noise)
    for error in result.errors:
        assert error.rmse_after == pytest.approx(noise[error.experiment, error.output], rel=0.05)
        # an estimated noise is that of the declared model, before the effects were found
        rough = 0.02 if name in UNKNOWN else 1e-6
        unit = result.noise[error.output] if name in UNKNOWN else sigma[error.output]
        assert error.normalised_before * unit == pytest.approx(error.rmse_before, rel=rough)
        assert error.normalised_after * unit == pytest.approx(error.rmse_after, rel=rough)
    for role in ("train", "test"):
        assert result.rms(role, "after") < 0.8 * result.rms(role, "before")
    for output, found in result.noise.items():
        assert found == pytest.approx(sigma[output], rel=0.1)


@pytest.mark.parametrize("name", each(COMPLETE))
def test_nothing_is_found_where_nothing_is_missing(name):
    data, result = closed(name)
    coloured = CASES[name].noise.correlation > 0.0
    assert result.verdict == (Verdict.COLOURED if coloured else Verdict.NONE)
    assert result.effects == result.rejected == ()
    assert result.after is result.before
    noise = drawn(data)
    for error in result.errors:
        assert error.rmse_after == error.rmse_before
        assert error.rmse_after == pytest.approx(noise[error.experiment, error.output], rel=0.05)
    for parameter, value in data.true_parameters.items():
        assert result.after.x[parameter] == pytest.approx(value, rel=0.02)


@pytest.mark.slow
def test_each_of_two_large_effects_is_compared_beside_the_other():
    """Without the load torque, the shaft's stops look like another law of its twist."""
    data = make(EVERY["two_mass_drive/pair/shaft_stops+load_torque x1.0"])
    result = ce.close_loop(make_problem(data))
    assert result.verdict == Verdict.FOUND
    found = {(effect.form, effect.site) for effect in result.effects}
    assert found == {("gap", "pair w_motor,w_load"), ("constant", "der(w_load)")}
