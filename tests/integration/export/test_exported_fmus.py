"""Repaired FMUs: events, state, reset, other interfaces, and what a fit makes of them."""

from __future__ import annotations

from dataclasses import replace

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
    needs_compiler,
    repair_of,
    unpacked,
)
from support.problems.springs import FMU
from support.truth.springs_with_effects import FORCE, START, TIMES, C, K, M, plain, pushed, solve

from cluster_est.errors import ModelError
from cluster_est.export.repaired_fmu.fmu import FmuOptions, write_fmu
from cluster_est.export.repaired_model import ReportedError
from workers.evaluate import Evaluator
from workers.fmu.description import describe
from workers.messages import Effect, Experiment, Input, Model, Output, Solver, Task
from workers.wire import TaskBatch

pytestmark = needs_compiler
EXACT = Solver("dormand_prince", rtol=1e-10)
LAG = Effect("late", "input F", "lag")
DELAY = Effect("later", "input F", "delay")
DRAG = Effect("drag", "der(v)", "quadratic")
SENSOR = Effect("slow", "output y", "lag")
TOGETHER = ((LAG, DELAY, DRAG, SENSOR), (0.05, 0.013, 0.7, 0.04))


def experiment(times=TIMES, force=FORCE):
    output = Output("y", times, np.zeros(len(times)))
    inputs = (Input("F", times, force),)
    return Experiment("e", 0.0, float(times[-1]), inputs, (output,), (("x", START[0]),))


def model(solver=EXACT, archive=None):
    interface = "co_simulation" if solver.name == "fmu" else "model_exchange"
    return Model(FMU.name, archive or FMU.read_bytes(), interface, solver, ("m", "k", "c"))


def simulated(of, measured, values, effects=(), want="trajectory"):
    evaluator = Evaluator(of, (measured,), "w")
    task = Task(0, 0, np.array(values), want, tuple(effects))
    (outcome,) = evaluator.evaluate(TaskBatch.of([task]))
    evaluator.close()
    assert outcome.ok, outcome.message
    return outcome.trajectory.values


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """The spring with a lag, a delay, a drag and a slow sensor, as an archive and as a folder."""
    folder = tmp_path_factory.mktemp("spring")
    repair = repair_of(model(), experiment(), (M, K, C), *TOGETHER)
    write_fmu(repair, folder / "spring.fmu")
    return folder / "spring.fmu", unpacked(repair, folder / "unpacked")


def test_fmpy_finds_nothing_wrong(spring):
    assert validate_fmu(str(spring[0])) == []


def test_get_and_set_state_reset_and_two_instances(spring):
    truth = simulated(model(), experiment(), (M, K, C, *TOGETHER[1]), TOGETHER[0])[:, 0]
    one, two = Exported(spring[1]), Exported(spring[1])
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


def test_coefficients_are_tunable_parameters(spring):
    exported = Exported(spring[1])
    assert exported.get("drag.k") == 0.7
    exported.set("drag.k", 0.1)
    exported.begin({"F": FORCE[0]})
    found = finely_co_simulated(exported, TIMES, {"F": FORCE}, "y")
    exported.close()
    values = (M, K, C, 0.05, 0.013, 0.1, 0.04)
    truth = simulated(model(), experiment(), values, TOGETHER[0])[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=2e-5)


def test_model_exchange_integrates_the_effects_states(tmp_path):
    """Against SciPy on equations that have the effects in them."""
    repair = repair_of(model(), experiment(), (M, K, C), (LAG, DRAG), (0.05, 0.7))
    write_fmu(repair, tmp_path / "spring.fmu")

    def slope(t, x, force):
        v, dv = plain(t, x, x[2])
        return [v, dv - 0.7 * x[1] * abs(x[1]), (force - x[2]) / 0.05]

    truth = solve(slope, (*START, FORCE[0]))[:, 0]
    described = describe("spring.fmu", (tmp_path / "spring.fmu").read_bytes())
    assert described.states == ("x", "v", "late.z")
    archive = (tmp_path / "spring.fmu").read_bytes()
    exported = Model("spring.fmu", archive, "model_exchange", EXACT, ())
    found = simulated(exported, experiment(), ())[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-7)


def test_the_derivative_that_is_read_has_the_effects(tmp_path):
    repair = repair_of(model(), experiment(), (M, K, C), (DRAG,), (0.7,))
    exported = Exported(unpacked(repair, tmp_path), FMU2Model)
    exported.begin({"x": 0.1, "v": 0.5, "F": 2.0})
    exported.fmu.enterContinuousTimeMode()
    expected = pushed(lambda t, x, f: -0.7 * x[1] * abs(x[1]))(0.0, np.array([0.1, 0.5]), 2.0)
    assert exported.get("der(v)") == pytest.approx(expected[1], rel=1e-14)
    exported.close()


def test_an_original_for_co_simulation_stays_one(tmp_path):
    of = model(Solver("fmu", step=0.005))
    repair = repair_of(of, experiment(), (M, K, C), (LAG, SENSOR), (0.05, 0.04))
    write_fmu(repair, tmp_path / "spring.fmu")
    assert validate_fmu(str(tmp_path / "spring.fmu")) == []
    assert describe("spring.fmu", (tmp_path / "spring.fmu").read_bytes()).interfaces == (
        "co_simulation",
    )
    exported = Exported(unpacked(repair, tmp_path / "unpacked"))
    exported.begin({"F": FORCE[0]})
    found = finely_co_simulated(exported, TIMES, {"F": FORCE}, "y")
    exported.close()
    truth = simulated(of, experiment(), (M, K, C, 0.05, 0.04), (LAG, SENSOR))[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize(
    ("solver", "fmi"),
    [(Solver("dormand_prince"), 2), (Solver("rk4", step=0.01), 2), (Solver("dormand_prince"), 3)],
)
def test_state_events_happen_when_they_did(own_fmu, tmp_path, fmpy_prints, solver, fmi):
    """A ball that bounces, with a drag on it."""
    archive = own_fmu("bouncing_ball", fmi)
    times = np.linspace(0.0, 2.0, 101)
    output = Output("h", times, np.zeros(101))
    measured = Experiment("e", 0.0, 2.0, (), (output,))
    of = Model(archive.name, archive.read_bytes(), "model_exchange", solver, ())
    drag = (Effect("drag", "der(v)", "viscous"),)
    repair = repair_of(of, measured, (), drag, (0.3,))
    write_fmu(repair, tmp_path / "ball.fmu")
    assert validate_fmu(str(tmp_path / "ball.fmu")) == []
    found = simulate_fmu(
        str(tmp_path / "ball.fmu"), stop_time=2.0, output_interval=0.02, output=["h"],
        fmi_type="CoSimulation",
    )  # fmt: skip
    truth = simulated(of, measured, (0.3,), drag)[:, 0]
    np.testing.assert_allclose(found["h"], truth, rtol=0.0, atol=1e-6)
    without = simulated(of, measured, ())[:, 0]
    assert np.abs(truth - without).max() > 1e-2
    exchange = Model("ball.fmu", (tmp_path / "ball.fmu").read_bytes(), "model_exchange", solver, ())
    np.testing.assert_allclose(simulated(exchange, measured, ())[:, 0], truth, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", ["step_events", "thermostat", "stair", "held_input"])
def test_other_events_pass_through(own_fmu, tmp_path, name, fmi):
    """Time events, step events, discrete outputs: without effects, as the original."""
    archive = own_fmu(name, fmi)
    description = describe(archive.name, archive.read_bytes())
    outputs = [n for n in description.outputs if description.variables[n].kind == "real"]
    stop = min(description.default_stop or 1.0, 8.0 if name == "stair" else 100.0)
    times = np.linspace(0.0, stop, 51)
    driven = [v.name for v in description.inputs() if v.kind == "real"]
    wave = np.where(np.sin(np.arange(51)) > 0.0, 600.0, 0.0)
    inputs = tuple(Input(n, times, wave, "hold") for n in driven)
    chosen = tuple(Output(n, times, np.zeros(51)) for n in outputs)
    measured = Experiment("e", 0.0, stop, inputs, chosen)
    of = Model(archive.name, archive.read_bytes(), "model_exchange", Solver("dormand_prince"), ())
    exported = Exported(unpacked(repair_of(of, measured, (), (), ()), tmp_path))
    exported.begin(dict.fromkeys(driven, wave[0]))
    found = co_simulated(exported, times, dict.fromkeys(driven, wave), outputs[0], hold=True)
    exported.close()
    truth = simulated(of, measured, ())[:, 0]
    np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_empty_folder_of_the_original_goes_along(own_fmu, tmp_path, fmi):
    archive = own_fmu("needs_resources", fmi)
    output = Output("y", TIMES, np.zeros(len(TIMES)))
    measured = Experiment("e", 0.0, float(TIMES[-1]), (), (output,))
    of = Model(archive.name, archive.read_bytes(), "model_exchange", EXACT, ("k",))
    drag = Effect("drag", "der(x)", "quadratic")
    write_fmu(repair_of(of, measured, (0.7,), (drag,), (0.5,)), tmp_path / "decay.fmu")
    found = simulate_fmu(
        str(tmp_path / "decay.fmu"), stop_time=float(TIMES[-1]), output_interval=float(TIMES[1]),
        fmi_type="CoSimulation",
    )  # fmt: skip
    truth = simulated(of, measured, (0.7, 0.5), (drag,))[:, 0]
    np.testing.assert_allclose(found["y"][: len(TIMES)], truth, rtol=1e-6)


def test_a_sensor_at_a_state_goes_along(tmp_path):
    output = Output("x", TIMES, np.zeros(len(TIMES)))
    measured = replace(experiment(), outputs=(output,))
    sensor = Effect("slow", "output x", "lag")
    repair = repair_of(model(), measured, (M, K, C), (sensor,), (0.04,))
    exported = Exported(unpacked(repair, tmp_path))
    exported.begin({"F": FORCE[0], "x": START[0]})
    found = finely_co_simulated(exported, TIMES, {"F": FORCE}, "x")
    exported.close()
    truth = simulated(model(), measured, (M, K, C, 0.04), (sensor,))[:, 0]
    np.testing.assert_allclose(found, truth, atol=2e-5)
    plain_outputs = simulated(model(), measured, (M, K, C))[:, 0]
    assert np.abs(truth - plain_outputs).max() > 1e-3


def test_a_measured_signal_that_an_effect_needs_becomes_an_input(tmp_path):
    wind = np.cos(3.0 * TIMES)
    measured = replace(experiment(), signals=(Input("wind", TIMES, wind),))
    effect = Effect("blow", "der(v)", "linear", ("wind",))
    repair = repair_of(model(), measured, (M, K, C), (effect,), (0.7,))
    exported = Exported(unpacked(repair, tmp_path))
    exported.begin({"F": FORCE[0], "wind": wind[0]})
    found = co_simulated(exported, TIMES, {"F": FORCE, "wind": wind}, "y")
    exported.close()
    truth = solve(pushed(lambda t, x, f: 0.7 * np.interp(t, TIMES, wind)))[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_original_with_a_fixed_step_keeps_it(own_fmu, tmp_path, fmi):
    archive = own_fmu("fixed_step", fmi)
    description = describe(archive.name, archive.read_bytes())
    step = description.fixed_internal_step or description.default_step or 0.1
    times = step * np.arange(21)
    chosen = Output(description.outputs[0], times, np.zeros(21))
    measured = Experiment("e", 0.0, float(times[-1]), (), (chosen,))
    of = Model(archive.name, archive.read_bytes(), "co_simulation", Solver("fmu"), ())
    gain = (Effect("gain", f"output {chosen.variable}", "gain"),)
    repair = repair_of(of, measured, (), gain, (0.5,))
    write_fmu(repair, tmp_path / "fixed.fmu")
    made = describe("fixed.fmu", (tmp_path / "fixed.fmu").read_bytes())
    assert not made.variable_steps
    exported = Exported(unpacked(repair, tmp_path / "unpacked"))
    exported.begin({})
    found = co_simulated(exported, times, {}, chosen.variable)
    exported.close()
    truth = simulated(of, measured, (0.5,), gain)[:, 0]
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_directional_derivatives_pass_through_where_no_effect_touches_them(own_fmu, tmp_path, fmi):
    archive = own_fmu("states_directional", fmi)
    description = describe(archive.name, archive.read_bytes())
    output = Output("y", np.array([0.0, 1.0]), np.zeros(2))
    of = Model(archive.name, archive.read_bytes(), "model_exchange", EXACT, ())
    measured = Experiment("e", 0.0, 1.0, (), (output,))
    x, y = (description.variables[name].reference for name in ("x", "y"))
    (rate,) = (v.reference for v in description.variables.values() if v.derivative_of == "x")
    for effects in ((), (Effect("push", "der(x)", "constant"),)):
        repair = repair_of(of, measured, (), effects, (0.5,) * len(effects))
        exported = Exported(unpacked(repair, tmp_path / str(len(effects))), FMU2Model)
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


@pytest.mark.parametrize("fmi", [2, 3])
def test_what_the_original_says_passes_through(own_fmu, tmp_path, fmi):
    """The strict test FMU knows no such reference."""
    archive = own_fmu("dahlquist", fmi)
    description = describe(archive.name, archive.read_bytes())
    output = Output(description.outputs[0], np.array([0.0, 1.0]), np.zeros(2))
    of = Model(archive.name, archive.read_bytes(), "model_exchange", EXACT, ())
    repair = repair_of(of, Experiment("e", 0.0, 1.0, (), (output,)), (), (), ())
    said = []
    exported = Exported(unpacked(repair, tmp_path), said=said)
    with pytest.raises(FMICallException):
        exported.fmu.setReal([99999], [1.0])
    exported.fmu.freeInstance()
    assert any(line.startswith("original FMU: ") for line in said)


def test_the_same_repair_is_the_same_archive(spring, tmp_path):
    repair = repair_of(model(), experiment(), (M, K, C), *TOGETHER)
    write_fmu(repair, tmp_path / "spring.fmu")
    assert (tmp_path / "spring.fmu").read_bytes() == spring[0].read_bytes()


def reported(repair, error):
    """The repair with an error of its only experiment, as a run has it."""
    (one,) = repair.problem.experiments
    values = {each.name: each.value for each in repair.parameters}
    row = ReportedError(one.id, "train", "y", "m", len(one.outputs[0].times), 1.0, error)
    return replace(repair, errors=(row,), of_experiments={one.id: values})


def test_a_step_that_reproduces_nothing_is_not_named(tmp_path):
    repair = reported(repair_of(model(), experiment(), (M, K, C), *TOGETHER), 1e-9)
    (sentence,) = write_fmu(repair, tmp_path / "spring.fmu")
    assert (
        "keeps inputs constant within a communication step does not reproduce the run" in sentence
    )
    assert "set input derivatives, or simulate by model exchange" in sentence


def test_a_platform_that_the_original_is_not_for_is_refused(own_fmu, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    archive = own_fmu("needs_resources", 2)
    of = Model(archive.name, archive.read_bytes(), "model_exchange", EXACT, ("k",))
    measured = Experiment("e", 0.0, 1.0, (), (Output("y", TIMES[:5], np.zeros(5)),))
    repair = repair_of(of, measured, (0.7,), (), ())
    with pytest.raises(
        ModelError, match="must have a binary for win64, which the exported FMU loads"
    ):
        write_fmu(repair, tmp_path / "decay.fmu", FmuOptions(("win64",)))
