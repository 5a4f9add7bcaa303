"""Events, both versions of FMI and every type, in all loops, against closed forms."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.simulated import answers
from support.truth.own_fmus import (
    bouncing_ball,
    dahlquist,
    iterates,
    nominals,
    stair,
    thermostat,
    van_der_pol,
)

from workers.messages import Experiment, Input, Model, Outcome, Output, Solver, Task

SOLVERS = {
    "dormand_prince": Solver("dormand_prince", rtol=1e-9),
    "rk4": Solver("rk4", 1e-3),
    "cvode": Solver("cvode", rtol=1e-10, atol=1e-10),
    "co_simulation": Solver("fmu", 1e-3),
}


def pairs(*solvers: str, versions: Sequence[int] = (2, 3)) -> pytest.MarkDecorator:
    """Each version with each solver."""
    every = [(fmi, name) for name in solvers for fmi in versions]
    cases = [
        pytest.param(
            fmi,
            "co_simulation" if name == "co_simulation" else "model_exchange",
            SOLVERS[name],
            id=f"{name}-{fmi}",
        )
        for fmi, name in every
    ]
    return pytest.mark.parametrize(("fmi", "interface", "solver"), cases)


EVERY = pairs(*SOLVERS)
EXCHANGE = pairs("rk4", "dormand_prince", "cvode")
ARRAYS = pairs(*SOLVERS, versions=[3])


@pytest.fixture
def simulate(own_fmu, fmi, interface, solver):
    """Simulate a test FMU at several points, with the solver of the case or one like it."""

    def run(
        name, outputs, times, parameters=(), points=((),), inputs=(), values=(), structure=(), **how
    ):
        fmu, zero = own_fmu(name, fmi), np.zeros(len(times))
        chosen = replace(solver, **how)
        model = Model(fmu.name, fmu.read_bytes(), interface, chosen, tuple(parameters), structure)
        measured = [Output(name, times, zero) for name in outputs]
        run = Experiment("e", 0.0, float(times[-1]), inputs, measured, values)
        tasks = [Task(i, 0, np.array(p, float), "trajectory") for i, p in enumerate(points)]
        return answers(model, [run], tasks)

    return run


def at(outcome: Outcome, times: np.ndarray) -> np.ndarray:
    """(times, outputs) of a simulation that must have succeeded."""
    assert outcome.ok, outcome.message
    found = outcome.trajectory
    return found.values[np.searchsorted(found.times, times)]


@EVERY
def test_bouncing_ball(simulate, interface):
    """Four balls in one batch: nothing of one is left in the next."""
    times = np.linspace(0.0, 3.0, 301)
    points = [[9.81, 0.7, 1.0], [9.81, 0.7, 2.0], [3.0, 0.5, 1.0], [9.81, 0.7, 1.0]]
    outputs = ["height", "velocity", "bounces"]
    outcomes = simulate("bouncing_ball", outputs, times, ["g", "e", "h"], points)
    for (g, e, h), outcome in zip(points, outcomes, strict=True):
        height, velocity, bounces = bouncing_ball(times, h, g, e)
        found = at(outcome, times)
        close = 1e-2 if interface == "co_simulation" else 1e-7
        np.testing.assert_allclose(found[:, 0], height, atol=close)
        if interface == "model_exchange":
            np.testing.assert_allclose(found[:, 1], velocity, atol=1e-6)
            np.testing.assert_array_equal(found[:, 2], bounces)
    first, last = outcomes[0].trajectory, outcomes[3].trajectory
    assert first.values.tobytes() == last.values.tobytes()


@EXCHANGE
def test_both_sides_of_an_event(simulate):
    """Measured a microsecond before and after the first bounce."""
    bounce = np.sqrt(2.0 / 9.81)
    times = np.array([0.0, bounce - 1e-6, bounce + 1e-6, 0.6])
    (outcome,) = simulate("bouncing_ball", ["velocity", "bounces"], times)
    _, velocity, bounces = bouncing_ball(times)
    found = at(outcome, times)
    np.testing.assert_allclose(found[:, 0], velocity, atol=1e-6)
    np.testing.assert_array_equal(found[:, 1], bounces)


@EVERY
def test_stair(simulate):
    """Time events, some of them at measured times; an integer output beside a discrete one."""
    times = np.array([0.0, 0.5, 0.9999, 1.0, 1.5, 2.0, 2.3, 3.0, 3.9999, 4.25])
    outcomes = simulate("stair", ["counter", "y"], times, ["height"], [[1.0], [2.5]])
    for height, outcome in zip([1.0, 2.5], outcomes, strict=True):
        found = at(outcome, times)
        np.testing.assert_array_equal(found[:, 0], stair(times))
        np.testing.assert_allclose(found[:, 1], stair(times, height), rtol=1e-12)


@EVERY
def test_an_end_by_the_fmu_is_a_failure_with_a_sentence(simulate):
    (outcome,) = simulate("stair", ["counter"], np.linspace(0.0, 12.0, 13))
    assert not outcome.ok
    assert outcome.message.startswith("the FMU ended the simulation by itself at t = 9 s")


@EVERY
def test_thermostat(simulate, interface, solver):
    times = np.linspace(0.0, 2000.0, 201)
    step = 1.0 if solver.step else None
    (outcome,) = simulate("thermostat", ["y", "on"], times, step=step)
    temperature, on, switches = thermostat(times)
    found = at(outcome, times)
    assert len(switches) > 3
    np.testing.assert_allclose(found[:, 0], temperature, atol=1e-5 if "ex" in interface else 0.1)
    if interface == "model_exchange":
        np.testing.assert_array_equal(found[:, 1], on)


@EVERY
def test_an_input_that_jumps_reaches_a_discrete_input(simulate):
    """x integrates a discrete input while another one, a boolean, is true."""
    times = np.linspace(0.0, 4.0, 41)
    inputs = (
        Input("u", np.array([0.0, 1.0, 2.5]), np.array([1.0, -2.0, 3.0]), "hold"),
        Input("enabled", np.array([0.0, 1.5, 2.0]), np.array([1.0, 0.0, 1.0]), "linear"),
    )
    (outcome,) = simulate("held_input", ["y"], times, ["gain"], [[2.0]], inputs)
    rates = [(0.0, 1.0), (1.0, -2.0), (1.5, 0.0), (2.0, -2.0), (2.5, 3.0), (4.0, 0.0)]
    knots = [t for t, _ in rates]
    steps = [r * (b - a) for (a, r), b in zip(rates[:-1], knots[1:], strict=True)]
    values = 2.0 * np.cumsum([0.0, *steps])
    np.testing.assert_allclose(at(outcome, times)[:, 0], np.interp(times, knots, values), atol=1e-9)


@EXCHANGE
def test_an_event_in_rounds_and_one_that_changes_nominals(simulate):
    how = {"step": 1e-3, "rtol": 1e-9, "atol": 1e-9}
    times = np.linspace(0.0, 4.3, 44)
    (outcome,) = simulate("iterates", ["y"], times, **how)
    np.testing.assert_allclose(at(outcome, times)[:, 0], iterates(times + 1e-12), atol=1e-8)
    (outcome,) = simulate("nominals", ["y"], times, **how)
    np.testing.assert_allclose(at(outcome, times)[:, 0], nominals(times)[0], rtol=1e-7)


@EXCHANGE
def test_chattering_is_a_failure(simulate):
    times, how = np.linspace(0.0, 2.0, 5), {"rtol": 1e-6, "max_steps": 20_000}
    (outcome,) = simulate("chatters", ["y"], times, step=1e-2, **how)
    assert not outcome.ok
    assert "model.max_steps" in outcome.message or "events" in outcome.message


@EVERY
def test_smooth_models(simulate, interface):
    times = np.linspace(0.0, 5.0, 26)
    outcomes = simulate("dahlquist", ["y"], times, ["k"], [[1.0], [0.3]])
    close = 2e-3 if interface == "co_simulation" else 1e-8
    for k, outcome in zip([1.0, 0.3], outcomes, strict=True):
        np.testing.assert_allclose(at(outcome, times)[:, 0], dahlquist(times, k), atol=close)
    (outcome,) = simulate("van_der_pol", ["y"], times)
    close = 2e-2 if interface == "co_simulation" else 1e-6
    np.testing.assert_allclose(at(outcome, times)[:, 0], van_der_pol(times)[:, 0], atol=close)


TYPED = {
    "real": (3.5, 2.5), "integer": (7, 5.0), "boolean": (False, -1.0), "mode": (3, 1.0),
    "text": ("seven..", 3.0),
}  # fmt: skip
TYPED_3 = {
    "float32": (1.5, 1.0), "int8": (-128, -120.0), "int16": (32767, 32783.0),
    "int64": (2**40, 2.0**40 + 64), "uint8": (255, 247.0), "uint16": (65535, 65519.0),
    "uint32": (2**32 - 1, 2.0**32 - 33), "uint64": (2**41, 2.0**41 - 64),
    "weights[2]": (6.0, 4.0),
}  # fmt: skip


@EVERY
def test_a_value_of_every_type_has_its_effect(own_fmu, fmi, interface, solver):
    fmu, times = own_fmu("types", fmi), np.array([0.0, 0.5, 1.0])
    given = TYPED if fmi == 2 else TYPED | TYPED_3
    values = [(), *(((name, value),) for name, (value, _) in given.items())]
    output = (Output("y", times, 0.0 * times),)
    runs = [Experiment(str(i), 0.0, 1.0, (), output, each) for i, each in enumerate(values)]
    model = Model(fmu.name, fmu.read_bytes(), interface, solver, ())
    tasks = [Task(i, i, np.zeros(0), "trajectory") for i in range(len(runs))]
    base, *found = [at(o, times)[-1, 0] for o in answers(model, runs, tasks)]
    for (name, (_, more)), y in zip(given.items(), found, strict=True):
        assert y - base == pytest.approx(more, rel=1e-6), name


@ARRAYS
def test_inputs_and_outputs_of_every_type(simulate):
    """Those that cannot move between events are held; an array has one that is driven."""
    times = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    knots = np.array([0.0, 1.0])
    given = {
        "u_integer": [3.0, -4.0], "u_boolean": [0.0, 1.0], "u_float32": [0.25, 0.75],
        "u_int64": [2.0**40, 7.0], "u_uint8": [1.0, 200.0], "u_vector[2]": [10.0, 10.0],
    }  # fmt: skip
    inputs = tuple(Input(name, knots, np.array(v), "hold") for name, v in given.items())
    late = times >= 1.0
    expected = {
        "y_integer": np.where(late, -2.0, 5.0), "y_boolean": np.where(late, 0.0, 1.0),
        "y_mode": np.full(5, 2.0), "y_float32": np.where(late, 1.25, 0.75),
        "y_int8": np.full(5, -8.0), "y_int16": np.full(5, -16.0),
        "y_int64": np.where(late, -57.0, 2.0**40 - 64.0),
        "y_uint8": np.where(late, 208.0, 9.0), "y_uint16": np.full(5, 16.0),
        "y_uint32": np.full(5, 32.0), "y_uint64": np.full(5, 64.0),
        "y_vector[1]": np.full(5, 1.0), "y_vector[2]": np.full(5, 12.0),
        "y_vector[3]": np.full(5, 3.0),
    }  # fmt: skip
    (outcome,) = simulate("types", list(expected), times, inputs=inputs)
    found = at(outcome, times)
    for column, (name, values) in enumerate(expected.items()):
        np.testing.assert_array_equal(found[:, column], values, name)


@ARRAYS
def test_a_structural_parameter_says_how_large_arrays_are(simulate, interface):
    """Four states decay, each at its own rate, of which one is estimated."""
    times = np.linspace(0.0, 1.0, 3)
    names = [f"y_z[{k}]" for k in (1, 2, 3, 4)]
    values = (("n", 4), ("rates[1]", 1.0), ("rates[3]", 3.0), ("rates[4]", 4.0))
    values += tuple((f"z[{k}]", 1.0) for k in (1, 2, 3, 4))
    outcomes = simulate(
        "types", names, times, ["rates[2]"], [[2.0], [0.5]], (), values, (("n", 4),)
    )
    close = 5e-3 if interface == "co_simulation" else 1e-6
    for rate, outcome in zip([2.0, 0.5], outcomes, strict=True):
        expected = np.exp(-np.outer(times, [1.0, rate, 3.0, 4.0]))
        np.testing.assert_allclose(at(outcome, times), expected, atol=close)
