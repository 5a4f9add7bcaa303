from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from fmpy import simulate_fmu
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Model
from fmpy.validation import validate_fmu
from support.exported import (
    Exported,
    co_simulated,
    finely_co_simulated,
    output_of,
    repair_of,
    unpacked,
    written,
)
from support.problems.driven_spring import driven, model_of
from support.simulated import simulated
from support.truth.springs_with_effects import FORCE, START, TIMES, C, K, M, plain, pushed, solve

from workers.core import build
from workers.fmu.description import describe
from workers.messages import Effect, Experiment, Input, Output, Solver

EXACT = Solver("dormand_prince", rtol=1e-10)
SPRING = model_of(EXACT)
LAG = Effect("late", "input F", "lag")
DELAY = Effect("later", "input F", "delay")
DRAG = Effect("drag", "der(v)", "quadratic")
SENSOR = Effect("slow", "output y", "lag")
TOGETHER = ((LAG, DELAY, DRAG, SENSOR), (0.05, 0.013, 0.7, 0.04))
EXAMPLES = sorted((Path(__file__).parents[3] / "configs" / "models").glob("*.fmu"))
FMI_2 = (2, pytest.param(3, marks=pytest.mark.slow))


def undriven(output, times):
    """An experiment of a model that starts by itself."""
    shown = Output(output, times, np.zeros(len(times)))
    return Experiment("e", 0.0, float(times[-1]), (), (shown,))


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """The spring with a lag, a delay, a drag and a slow sensor, as a folder."""
    repair = repair_of(SPRING, driven(), (M, K, C), *TOGETHER)
    return unpacked(repair, tmp_path_factory.mktemp("spring"))


@pytest.fixture(scope="module")
def followed():
    """What its output is in a simulation of ours, with this much drag."""

    def of(drag):
        values = (M, K, C, 0.05, 0.013, drag, 0.04)
        return simulated(SPRING, driven(), values, TOGETHER[0])[:, 0]

    return of


def test_fmpy_finds_nothing_wrong(spring):
    assert validate_fmu(str(spring / "exported.fmu")) == []


def test_get_and_set_state_reset_and_two_instances(spring, followed):
    truth = followed(0.7)
    one, two = Exported(spring), Exported(spring)
    for exported in (one, two):
        exported.begin({"F": FORCE[0]})
    middle = 77
    first = co_simulated(one, TIMES[: middle + 1], {"F": FORCE[: middle + 1]}, "y")
    state = one.fmu.getFMUState()
    kept = one.fmu.serializeFMUstate(state)
    rest = co_simulated(one, TIMES, {"F": FORCE}, "y", first=middle)
    one.fmu.setFMUState(state)
    again = co_simulated(one, TIMES, {"F": FORCE}, "y", first=middle)
    one.fmu.freeFMUState(state)
    one.fmu.setFMUState(one.fmu.deSerializeFMUstate(kept))
    once_more = co_simulated(one, TIMES, {"F": FORCE}, "y", first=middle)
    np.testing.assert_allclose([*first, *rest[1:]], truth, rtol=0.0, atol=1e-4)
    assert again.tobytes() == rest.tobytes() == once_more.tobytes()
    other = co_simulated(two, TIMES, {"F": FORCE}, "y")
    one.fmu.reset()
    one.begin({"F": FORCE[0]})
    afresh = co_simulated(one, TIMES, {"F": FORCE}, "y")
    assert afresh.tobytes() == other.tobytes()
    np.testing.assert_allclose(afresh, truth, rtol=0.0, atol=1e-4)
    one.close()
    two.close()


def test_coefficients_are_tunable_parameters(spring, followed):
    exported = Exported(spring)
    assert exported.get("drag.k") == 0.7
    exported.set("drag.k", 0.1)
    exported.begin({"F": FORCE[0]})
    found = finely_co_simulated(exported, TIMES, {"F": FORCE}, "y")
    exported.close()
    np.testing.assert_allclose(found, followed(0.1), rtol=0.0, atol=2e-5)


def test_model_exchange_integrates_the_effects_states(tmp_path):
    """Against SciPy on equations that have the effects in them."""
    repair = repair_of(SPRING, driven(), (M, K, C), (LAG, DRAG), (0.05, 0.7))
    folder = unpacked(repair, tmp_path)

    def slope(t, x, force):
        v, dv = plain(t, x, x[2])
        return [v, dv - 0.7 * x[1] * abs(x[1]), (force - x[2]) / 0.05]

    exported = Exported(folder, FMU2Model)
    exported.begin({"x": 0.1, "v": 0.5, "F": 2.0})
    exported.fmu.enterContinuousTimeMode()
    expected = slope(0.0, np.array([0.1, 0.5, 2.0]), 2.0)
    assert exported.get("der(v)") == pytest.approx(expected[1], rel=1e-14)
    exported.close()
    exchange = model_of(EXACT, (), folder / "exported.fmu")
    assert describe(exchange.name, exchange.archive).states == ("x", "v", "late.z")
    found = simulated(exchange, driven(), ())[:, 0]
    truth = solve(slope, (*START, FORCE[0]))[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-7)


@pytest.mark.slow
def test_an_original_for_co_simulation_stays_one(tmp_path):
    of = model_of(Solver("fmu", step=0.005))
    repair = repair_of(of, driven(), (M, K, C), (LAG, SENSOR), (0.05, 0.04))
    folder = unpacked(repair, tmp_path)
    path = folder / "exported.fmu"
    assert validate_fmu(str(path)) == []
    assert describe("spring.fmu", path.read_bytes()).interfaces == ("co_simulation",)
    found = output_of(folder, TIMES, {"F": FORCE}, "y", follow=finely_co_simulated)
    truth = simulated(of, driven(), (M, K, C, 0.05, 0.04), (LAG, SENSOR))[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("solver", [Solver("rk4", step=0.01), Solver("dormand_prince")])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.slow
def test_state_events_happen_when_they_did(own_fmu, tmp_path, fmpy_prints, solver, fmi):
    """A ball that bounces, with a drag on it."""
    of = model_of(solver, (), own_fmu("bouncing_ball", fmi))
    measured = undriven("h", np.linspace(0.0, 2.0, 101))
    drag, path = (Effect("drag", "der(v)", "viscous"),), tmp_path / "ball.fmu"
    written(repair_of(of, measured, (), drag, (0.3,)), path)
    assert validate_fmu(str(path)) == []
    found = simulate_fmu(
        str(path), stop_time=2.0, output_interval=0.02, output=["h"], fmi_type="CoSimulation"
    )
    truth = simulated(of, measured, (0.3,), drag)[:, 0]
    np.testing.assert_allclose(found["h"], truth, rtol=0.0, atol=1e-6)
    assert np.abs(truth - simulated(of, measured, ())[:, 0]).max() > 1e-2
    exchanged = simulated(model_of(solver, (), path), measured, ())[:, 0]
    np.testing.assert_allclose(exchanged, truth, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "fmi"),
    [
        pytest.param(*case, marks=() if case == ("thermostat", 2) else pytest.mark.slow)
        for case in product(("step_events", "thermostat", "stair", "held_input"), (2, 3))
    ],
)
def test_other_events_pass_through(own_fmu, tmp_path, name, fmi):
    """Time events, step events, discrete outputs: without effects, as the original."""
    of = model_of(Solver("dormand_prince"), (), own_fmu(name, fmi))
    description = describe(of.name, of.archive)
    outputs = [n for n in description.outputs if description.variables[n].kind == "real"]
    stop = min(description.default_stop or 1.0, 8.0 if name == "stair" else 100.0)
    times = np.linspace(0.0, stop, 51)
    driven = [v.name for v in description.inputs() if v.kind == "real"]
    wave = np.where(np.sin(np.arange(51)) > 0.0, 600.0, 0.0)
    inputs = tuple(Input(n, times, wave, "hold") for n in driven)
    measured = replace(undriven(outputs[0], times), inputs=inputs)
    folder = unpacked(repair_of(of, measured, (), (), ()), tmp_path)
    found = output_of(folder, times, dict.fromkeys(driven, wave), outputs[0], hold=True)
    truth = simulated(of, measured, ())[:, 0]
    np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.slow
def test_an_empty_folder_of_the_original_goes_along(own_fmu, tmp_path, fmi):
    of = model_of(EXACT, ("k",), own_fmu("needs_resources", fmi))
    measured, drag = undriven("y", TIMES), Effect("drag", "der(x)", "quadratic")
    written(repair_of(of, measured, (0.7,), (drag,), (0.5,)), tmp_path / "decay.fmu")
    how = {"stop_time": float(TIMES[-1]), "output_interval": float(TIMES[1])}
    found = simulate_fmu(str(tmp_path / "decay.fmu"), fmi_type="CoSimulation", **how)
    truth = simulated(of, measured, (0.7, 0.5), (drag,))[:, 0]
    np.testing.assert_allclose(found["y"][: len(TIMES)], truth, rtol=1e-6)


@pytest.mark.slow
def test_a_sensor_at_a_state_goes_along_and_a_measured_signal_becomes_an_input(tmp_path):
    wind = np.cos(3.0 * TIMES)
    signals, shown = (Input("wind", TIMES, wind),), (Output("x", TIMES, np.zeros(len(TIMES))),)
    measured = replace(driven(), outputs=shown, signals=signals)
    effects = Effect("blow", "der(v)", "linear", ("wind",)), Effect("slow", "output x", "lag")
    folder = unpacked(repair_of(SPRING, measured, (M, K, C), effects, (0.7, 0.04)), tmp_path)

    inputs, start = {"F": FORCE, "wind": wind}, {"x": START[0]}
    found = output_of(folder, TIMES, inputs, "y", start)
    finely = output_of(folder, TIMES, inputs, "x", start, finely_co_simulated)
    truth = solve(pushed(lambda t, x, f: 0.7 * np.interp(t, TIMES, wind)))[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-7)
    late = simulated(SPRING, measured, (M, K, C, 0.7, 0.04), effects)[:, 0]
    np.testing.assert_allclose(finely, late, atol=2e-5)
    assert np.abs(truth - late).max() > 1e-3


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.slow
def test_an_original_with_a_fixed_step_keeps_it(own_fmu, tmp_path, fmi):
    of = model_of(Solver("fmu"), (), own_fmu("fixed_step", fmi))
    description = describe(of.name, of.archive)
    step = description.fixed_internal_step or description.default_step or 0.1
    times, shown = step * np.arange(21), description.outputs[0]
    measured, gain = undriven(shown, times), (Effect("gain", f"output {shown}", "gain"),)
    folder = unpacked(repair_of(of, measured, (), gain, (0.5,)), tmp_path)
    assert not describe("fixed.fmu", (folder / "exported.fmu").read_bytes()).variable_steps
    found = output_of(folder, times, {}, shown)
    truth = simulated(of, measured, (0.5,), gain)[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("fmi", FMI_2)
@pytest.mark.parametrize(
    "effects",
    [pytest.param((), marks=pytest.mark.slow), (Effect("push", "der(x)", "constant"),)],
    ids=len,
)
def test_directional_derivatives_pass_through_where_no_effect_touches_them(
    own_fmu, tmp_path, effects, fmi
):
    of = model_of(EXACT, (), own_fmu("states_directional", fmi))
    description = describe(of.name, of.archive)
    x, y = (description.variables[name].reference for name in ("x", "y"))
    (rate,) = (v.reference for v in description.variables.values() if v.derivative_of == "x")
    measured = undriven("y", np.array([0.0, 1.0]))
    repair = repair_of(of, measured, (), effects, (0.5,) * len(effects))
    exported = Exported(unpacked(repair, tmp_path), FMU2Model)
    exported.begin({})
    exported.fmu.newDiscreteStates()
    exported.fmu.enterContinuousTimeMode()
    derivative = exported.fmu.getDirectionalDerivative
    assert list(derivative([y], [x], [1.0])) == [2.0]
    if effects:
        with pytest.raises(FMICallException):
            derivative([rate], [x], [1.0])
    else:
        assert list(derivative([rate], [x], [1.0])) == [-1.0]
    exported.close()


@pytest.mark.parametrize("fmi", FMI_2)
@pytest.mark.slow
def test_what_the_original_says_passes_through(own_fmu, tmp_path, fmi):
    """The strict test FMU knows no such reference."""
    of = model_of(EXACT, (), own_fmu("dahlquist", fmi))
    measured = undriven(describe(of.name, of.archive).outputs[0], np.array([0.0, 1.0]))
    said = []
    exported = Exported(unpacked(repair_of(of, measured, (), (), ()), tmp_path), said=said)
    with pytest.raises(FMICallException):
        exported.fmu.setReal([99999], [1.0])
    exported.fmu.freeInstance()
    assert any(line.startswith("original FMU: ") for line in said)


@pytest.mark.slow
def test_the_same_repair_is_the_same_archive(spring, tmp_path):
    written(repair_of(SPRING, driven(), (M, K, C), *TOGETHER), tmp_path / "spring.fmu")
    assert (tmp_path / "spring.fmu").read_bytes() == (spring / "exported.fmu").read_bytes()


@pytest.mark.slow
def test_a_step_that_reproduces_nothing_is_not_named(tmp_path):
    row = {"experiment": "e", "role": "train", "output": "y", "unit": "m", "samples": len(TIMES)}
    error = row | {"rmse_before": 1.0, "rmse_after": 1e-9}
    repair = repair_of(SPRING, driven(), (M, K, C), *TOGETHER, [error])
    (sentence,) = written(repair, tmp_path / "spring.fmu")
    assert "inputs constant within a communication step does not reproduce the run" in sentence
    assert "set input derivatives, or simulate by model exchange" in sentence


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
@pytest.mark.slow
def test_without_effects_an_example_has_the_bits_of_the_original(
    tmp_path, path, kind, monkeypatch, fmpy_prints
):
    """In co-simulation of an original for it, and in model exchange; no compiler can be found."""
    solver = Solver("fmu") if kind == "CoSimulation" else Solver("dormand_prince")
    of = model_of(solver, (), path)
    output = next(n for n in describe(of.name, of.archive).outputs)
    build.library("wrapper", build.this_platform())  # an installation has it
    monkeypatch.setenv("PATH", str(tmp_path))
    written(repair_of(of, undriven(output, np.array([0.0, 1.0])), (), (), ()), tmp_path / "a.fmu")
    assert validate_fmu(str(tmp_path / "a.fmu")) == []
    how = {"stop_time": 1.0, "output_interval": 0.125, "output": [output], "fmi_type": kind}
    how |= {"solver": "Euler", "step_size": 0.015625} if kind == "ModelExchange" else {}
    one, other = (simulate_fmu(str(p), **how) for p in (path, tmp_path / "a.fmu"))
    assert one[output].tobytes() == other[output].tobytes()
