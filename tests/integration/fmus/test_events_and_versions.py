"""Events, both versions of FMI and every type, in the compiled loops, against closed forms."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

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

Give = Callable[[str, int], Path]

SOLVERS = {
    "dormand_prince": Solver("dormand_prince", rtol=1e-9),
    "rk4": Solver("rk4", 1e-3),
    "cvode": Solver("cvode", rtol=1e-10, atol=1e-10),
    "co_simulation": Solver("fmu", 1e-3),
}


def pairs(*solvers: str, versions: Sequence[int] = (2, 3)) -> pytest.MarkDecorator:
    """Each version and each solver, and by default not every pair of them."""
    every = [(fmi, name) for name in solvers for fmi in versions]
    usual = {(versions[i % len(versions)], name) for i, name in enumerate(solvers)}
    cases = [
        pytest.param(
            fmi,
            "co_simulation" if name == "co_simulation" else "model_exchange",
            SOLVERS[name],
            marks=() if (fmi, name) in usual else pytest.mark.slow,
            id=f"{name}-{fmi}",
        )
        for fmi, name in every
    ]
    return pytest.mark.parametrize(("fmi", "interface", "solver"), cases)


EVERY = pairs(*SOLVERS)
EXCHANGE = pairs("rk4", "dormand_prince", "cvode")
ARRAYS = pairs(*SOLVERS, versions=[3])


def simulate(
    fmu: Path,
    interface: str,
    solver: Solver,
    outputs: Sequence[str],
    times: np.ndarray,
    parameters: Sequence[str] = (),
    points: Sequence[Sequence[float]] = ((),),
    inputs: tuple[Input, ...] = (),
    values: tuple[tuple[str, object], ...] = (),
    structure: tuple[tuple[str, int], ...] = (),
) -> list[Outcome]:
    model = Model(fmu.name, fmu.read_bytes(), interface, solver, tuple(parameters), structure)
    zero = np.zeros(len(times))
    run = Experiment(
        "e", 0.0, float(times[-1]), inputs, tuple(Output(n, times, zero) for n in outputs), values
    )
    tasks = [Task(i, 0, np.array(p, float), "trajectory") for i, p in enumerate(points)]
    return answers(model, [run], tasks)


def at(outcome: Outcome, times: np.ndarray) -> np.ndarray:
    """(times, outputs) of a simulation that must have succeeded."""
    assert outcome.ok, outcome.message
    found = outcome.trajectory
    return found.values[np.searchsorted(found.times, times)]


@EVERY
def test_bouncing_ball(own_fmu: Give, fmi: int, interface: str, solver: Solver) -> None:
    """Four balls in one batch: nothing of one is left in the next."""
    times = np.linspace(0.0, 3.0, 301)
    points = [[9.81, 0.7, 1.0], [9.81, 0.7, 2.0], [3.0, 0.5, 1.0], [9.81, 0.7, 1.0]]
    outcomes = simulate(
        own_fmu("bouncing_ball", fmi), interface, solver, ["height", "velocity", "bounces"],
        times, ["g", "e", "h"], points,
    )  # fmt: skip
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
def test_both_sides_of_an_event(own_fmu: Give, fmi: int, interface: str, solver: Solver) -> None:
    """Measured a microsecond before and after the first bounce."""
    bounce = np.sqrt(2.0 / 9.81)
    times = np.array([0.0, bounce - 1e-6, bounce + 1e-6, 0.6])
    (outcome,) = simulate(
        own_fmu("bouncing_ball", fmi), interface, solver, ["velocity", "bounces"], times
    )
    _, velocity, bounces = bouncing_ball(times)
    found = at(outcome, times)
    np.testing.assert_allclose(found[:, 0], velocity, atol=1e-6)
    np.testing.assert_array_equal(found[:, 1], bounces)


@EVERY
def test_stair(own_fmu: Give, fmi: int, interface: str, solver: Solver) -> None:
    """Time events, some of them at measured times; an integer output beside a discrete one."""
    times = np.array([0.0, 0.5, 0.9999, 1.0, 1.5, 2.0, 2.3, 3.0, 3.9999, 4.25])
    outcomes = simulate(
        own_fmu("stair", fmi), interface, solver, ["counter", "y"], times, ["height"],
        [[1.0], [2.5]],
    )  # fmt: skip
    for height, outcome in zip([1.0, 2.5], outcomes, strict=True):
        found = at(outcome, times)
        np.testing.assert_array_equal(found[:, 0], stair(times))
        np.testing.assert_allclose(found[:, 1], stair(times, height), rtol=1e-12)


@EVERY
def test_an_end_by_the_fmu_is_a_failure_with_a_sentence(
    own_fmu: Give, fmi: int, interface: str, solver: Solver
) -> None:
    (outcome,) = simulate(
        own_fmu("stair", fmi), interface, solver, ["counter"], np.linspace(0.0, 12.0, 13)
    )
    assert not outcome.ok
    assert outcome.message.startswith("the FMU ended the simulation by itself at t = 9 s")


@EVERY
def test_thermostat(own_fmu: Give, fmi: int, interface: str, solver: Solver) -> None:
    times = np.linspace(0.0, 2000.0, 201)
    solver = Solver(solver.name, 1.0 if solver.step else None, solver.rtol)
    (outcome,) = simulate(own_fmu("thermostat", fmi), interface, solver, ["y", "on"], times)
    temperature, on, switches = thermostat(times)
    found = at(outcome, times)
    assert len(switches) > 3
    np.testing.assert_allclose(found[:, 0], temperature, atol=1e-5 if "ex" in interface else 0.1)
    if interface == "model_exchange":
        np.testing.assert_array_equal(found[:, 1], on)


@EVERY
def test_an_input_that_jumps_reaches_a_discrete_input(
    own_fmu: Give, fmi: int, interface: str, solver: Solver
) -> None:
    """x integrates a discrete input while another one, a boolean, is true."""
    times = np.linspace(0.0, 4.0, 41)
    inputs = (
        Input("u", np.array([0.0, 1.0, 2.5]), np.array([1.0, -2.0, 3.0]), "hold"),
        Input("enabled", np.array([0.0, 1.5, 2.0]), np.array([1.0, 0.0, 1.0]), "linear"),
    )
    (outcome,) = simulate(
        own_fmu("held_input", fmi), interface, solver, ["y"], times, ["gain"], [[2.0]], inputs
    )
    rates = [(0.0, 1.0), (1.0, -2.0), (1.5, 0.0), (2.0, -2.0), (2.5, 3.0), (4.0, 0.0)]
    knots = [t for t, _ in rates]
    steps = [r * (b - a) for (a, r), b in zip(rates[:-1], knots[1:], strict=True)]
    values = 2.0 * np.cumsum([0.0, *steps])
    np.testing.assert_allclose(at(outcome, times)[:, 0], np.interp(times, knots, values), atol=1e-9)


@EXCHANGE
def test_an_event_in_rounds_and_one_that_changes_nominals(
    own_fmu: Give, fmi: int, interface: str, solver: Solver
) -> None:
    how = Solver(solver.name, 1e-3, 1e-9, 1e-9)
    times = np.linspace(0.0, 4.3, 44)
    (outcome,) = simulate(own_fmu("iterates", fmi), interface, how, ["y"], times)
    np.testing.assert_allclose(at(outcome, times)[:, 0], iterates(times + 1e-12), atol=1e-8)
    (outcome,) = simulate(own_fmu("nominals", fmi), interface, how, ["y"], times)
    np.testing.assert_allclose(at(outcome, times)[:, 0], nominals(times)[0], rtol=1e-7)


@EXCHANGE
def test_chattering_is_a_failure(own_fmu: Give, fmi: int, interface: str, solver: Solver) -> None:
    how = Solver(solver.name, 1e-2, 1e-6, max_steps=20_000)
    times = np.linspace(0.0, 2.0, 5)
    (outcome,) = simulate(own_fmu("chatters", fmi), interface, how, ["y"], times)
    assert not outcome.ok
    assert "the limit on the number of steps" in outcome.message or "events" in outcome.message


@EVERY
def test_smooth_models(own_fmu: Give, fmi: int, interface: str, solver: Solver) -> None:
    times = np.linspace(0.0, 5.0, 26)
    outcomes = simulate(
        own_fmu("dahlquist", fmi), interface, solver, ["y"], times, ["k"], [[1.0], [0.3]]
    )
    close = 2e-3 if interface == "co_simulation" else 1e-8
    for k, outcome in zip([1.0, 0.3], outcomes, strict=True):
        np.testing.assert_allclose(at(outcome, times)[:, 0], dahlquist(times, k), atol=close)
    (outcome,) = simulate(own_fmu("van_der_pol", fmi), interface, solver, ["y"], times)
    close = 2e-2 if interface == "co_simulation" else 1e-6
    np.testing.assert_allclose(at(outcome, times)[:, 0], oscillation(), atol=close)


@cache
def oscillation() -> np.ndarray:
    return van_der_pol(np.linspace(0.0, 5.0, 26))[:, 0]


TYPED = {
    "real": (3.5, 2.5), "integer": (7, 5.0), "boolean": (False, -1.0), "mode": (3, 1.0),
    "text": ("seven..", 3.0),
}  # fmt: skip
TYPED_3 = {
    "float32": (1.5, 1.0), "int8": (-128, -120.0), "int16": (32767, 32783.0),
    "int64": (2**40, 2.0**40 + 64), "uint8": (255, 247.0), "uint16": (65535, 65519.0),
    "uint32": (2**32 - 1, 2.0**32 - 33), "uint64": (2**41, 2.0**41 - 64),
}  # fmt: skip


@EVERY
def test_a_value_of_every_type_has_its_effect(
    own_fmu: Give, fmi: int, interface: str, solver: Solver
) -> None:
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
def test_inputs_and_outputs_of_every_type(
    own_fmu: Give, fmi: int, interface: str, solver: Solver
) -> None:
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
    (outcome,) = simulate(
        own_fmu("types", fmi), interface, solver, list(expected), times, inputs=inputs
    )
    found = at(outcome, times)
    for column, (name, values) in enumerate(expected.items()):
        np.testing.assert_array_equal(found[:, column], values, name)


@ARRAYS
def test_a_structural_parameter_says_how_large_arrays_are(
    own_fmu: Give, fmi: int, interface: str, solver: Solver
) -> None:
    """Four states decay, each at its own rate, of which one is estimated."""
    times = np.linspace(0.0, 1.0, 3)
    names = [f"y_z[{k}]" for k in (1, 2, 3, 4)]
    values = (("n", 4), ("rates[1]", 1.0), ("rates[3]", 3.0), ("rates[4]", 4.0))
    values += tuple((f"z[{k}]", 1.0) for k in (1, 2, 3, 4))
    outcomes = simulate(
        own_fmu("types", fmi), interface, solver, names, times, ["rates[2]"], [[2.0], [0.5]],
        values=values, structure=(("n", 4),),
    )  # fmt: skip
    close = 5e-3 if interface == "co_simulation" else 1e-6
    for rate, outcome in zip([2.0, 0.5], outcomes, strict=True):
        expected = np.exp(-np.outer(times, [1.0, rate, 3.0, 4.0]))
        np.testing.assert_allclose(at(outcome, times), expected, atol=close)
