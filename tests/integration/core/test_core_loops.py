"""How simulations end, alone and in a batch, and what FMUs with events give: recorded once.

The numbers were recorded from loops of another language, which had the same bits.
"""

import json
from ctypes import addressof, c_int64
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import FMU
from support.thinning import thinned

from workers.core import failure
from workers.core.library import Settings, core
from workers.fmu.description import describe
from workers.messages import Experiment, Input, Model, Output, Solver
from workers.simulation.batch import simulate
from workers.simulation.simulator import Simulator

RECORDED = Path(__file__).with_name("event_fmus.json")
TIMES = np.linspace(0.0, 3.7, 38)
NAMES = (
    "bouncing_ball", "stair", "step_events", "thermostat", "types", "van_der_pol", "nominals",
    "iterates", "held_input", "lazy_indicators", "chatters", "needs_stop_time", "refuses_parameter",
    "fixed_step",
)  # fmt: skip
HOWS = [
    ("fmu", None), ("fmu", 0.07), ("rk4", 0.01), ("rk4", None), ("dormand_prince", None),
    ("dormand_prince", 0.013), ("cvode", None),
]  # fmt: skip
CASES = thinned(
    [
        (name, fmi, solver, step)
        for name in NAMES
        for fmi in (2, 3)
        for solver, step in HOWS
        if name != "fixed_step" or solver == "fmu"  # it offers nothing else
    ],
    lambda name, *_: name,
    lambda _, fmi, solver, __: (fmi, solver),
)
UNDRIVEN = ("Clock", "Binary")


def simulator_of(path, solver, step, parameters=(), kind="linear"):
    """An FMU whose every input is driven, and whose outputs and states are recorded."""
    described = describe(path.name, path.read_bytes())
    numbers = [v for v in described.inputs() if v.kind != "string" and v.type not in UNDRIVEN]
    inputs = tuple(
        Input(v.name, TIMES, np.round(np.sin(3.0 * TIMES + i), 3) if v.kind == "real" else
              np.floor(TIMES) % 2, kind)
        for i, v in enumerate(numbers) if v.size == 1
    )  # fmt: skip
    outputs = [
        v.name for v in described.variables.values()
        if v.causality == "output" and v.kind != "string" and v.type not in UNDRIVEN
    ]  # fmt: skip
    outputs += () if solver == "fmu" else described.states
    recorded = tuple(Output(name, TIMES, 0.0 * TIMES) for name in dict.fromkeys(outputs))
    interface = "co_simulation" if solver == "fmu" else "model_exchange"
    how = Solver(solver, step=step, rtol=1e-6)
    model = Model(path.name, path.read_bytes(), interface, how, parameters)
    experiment = Experiment("a", 0.0, 3.7, inputs, recorded)
    simulator = Simulator(model, described, (experiment,))
    simulator.load()
    return simulator


def weighed(batch):
    """One number for all outputs of the first point, and the code and steps of both."""
    values = batch.outputs[0].ravel()
    total = float(np.nansum(values * np.cos(np.arange(len(values)))))
    return [total, *batch.codes.tolist(), *batch.steps.tolist()]


@pytest.mark.parametrize(("name", "fmi", "solver", "step"), CASES)
def test_fmus_with_events_give_what_was_recorded(own_fmu, name, fmi, solver, step):
    """With state, time and step events, discrete inputs, and all types."""
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
    for kind in ("linear", "hold"):
        simulator = simulator_of(own_fmu(name, fmi), solver, step, kind=kind)
        total, *counts = weighed(simulator.run(0, np.zeros((2, 0))))
        simulator.close()
        expected, *counted = recorded[f"{name} {fmi} {solver} {step} {kind}"]
        assert counts == counted
        assert total == pytest.approx(expected, rel=1e-9, abs=1e-9)


POINTS = np.array([[1.0, 25.0, 0.8], [1.1, 24.0, 0.7], [-1.0, 25.0, 0.8], [1.0, 20.0, 0.5]])


@pytest.mark.parametrize(("solver", "step"), HOWS)
def test_failures_and_bounds_end_a_simulation_and_no_other(solver, step):
    bounds = np.array([np.inf, 1e-3, np.inf, 1e-5])
    simulator = simulator_of(FMU, solver, step, ("m", "k", "c"))
    alone = simulator.run(0, POINTS[:1])
    found = simulator.run(0, POINTS, bounds=bounds)
    whole = simulator.run(0, POINTS)
    simulator.close()
    early = failure.ENDED_EARLY
    assert found.codes.tolist() == [0, early, failure.INITIALISATION, early]
    assert whole.codes.tolist() == [0, 0, failure.INITIALISATION, 0]
    assert "mass must be positive, got -1" in found.messages[2]
    np.testing.assert_array_equal(found.outputs[0], alone.outputs[0])
    for p in (1, 3):
        there = np.isfinite(found.outputs[p, :, 0])
        assert 0 < there.sum() < len(TIMES)
        np.testing.assert_array_equal(found.outputs[p, there], whole.outputs[p, there])
        assert np.sum(whole.outputs[p, there] ** 2) > bounds[p]
        assert np.sum(whole.outputs[p, there][:-1] ** 2) <= bounds[p]
    assert np.isnan(found.outputs[2]).all()


@pytest.mark.parametrize("solver", ["fmu", "rk4", "dormand_prince", "cvode"])
def test_a_failure_has_a_time_and_an_index(solver):
    simulator = simulator_of(FMU, solver, None, ("m", "k", "c"))
    indices, integrator = [], simulator._integrator

    def run(batch):
        too_few = Settings.from_buffer_copy(Settings.from_address(batch.settings))
        too_few.max_steps, batch.settings = 0, addressof(too_few)
        tried = integrator.loop(batch)
        indices.append(c_int64.from_address(batch.indices).value)
        return tried

    batch = integrator.run(simulator.bound_experiment(0), POINTS[:1], loop=run)
    assert batch.codes[0] == failure.TOO_MANY_STEPS
    assert "model.max_steps" in batch.messages[0]
    assert indices == [0]
    simulator.close()


def test_a_failure_between_two_times_of_the_grid_is_at_its_step(own_fmu):
    simulator = simulator_of(own_fmu("robertson", 2), "rk4", 0.01)
    found = simulator.run(0, np.zeros((1, 0)))
    simulator.close()
    assert found.codes[0] == failure.STEP
    assert "t = 0.02 s" in found.messages[0]


def test_sizes_that_do_not_fit_are_refused_with_a_sentence():
    simulator = simulator_of(FMU, "rk4", None, ("m", "k", "c"))

    def run(batch):
        batch.n_states = 7
        return simulate(batch)

    found = simulator._integrator.run(simulator.bound_experiment(0), POINTS[:1], loop=run)
    assert found.codes[0] == failure.WRONG_SIZES
    assert "fault of cluster-est" in found.messages[0]
    simulator.close()


def test_many_batches_share_nothing():
    """A batch of each kind after the others gives the bits that it gives alone."""
    simulator = simulator_of(FMU, "rk4", None, ("m", "k", "c"))
    first = simulator.run(0, POINTS[:1]).outputs
    simulator.run(0, POINTS[[3, 2, 1]])
    again = simulator.run(0, POINTS[[1, 0]]).outputs[1:]
    simulator.close()
    np.testing.assert_array_equal(again, first)
    assert core() is core()
