"""The core against the compiled loops: the same bits, steps and messages."""

import numpy as np
import pytest
from support.core_batches import core_batch, simulate, with_c_library
from support.problems.springs import FMU
from support.thinning import thinned

from workers.core.library import WRONG_SIZES
from workers.fmu.description import describe
from workers.kernels.fmi.hooks import no_hooks
from workers.kernels.solvers.cvode import CvodeBatch
from workers.messages import Experiment, Input, Model, Output, Solver
from workers.simulation.simulator import Simulator

pytestmark = pytest.mark.slow

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
    simulator._integrator.find_jacobian(simulator._bound[0])
    return simulator


UNDRIVEN = ("Clock", "Binary")


def compare(simulator, solver, points, bounds=None):
    integrator, bound = simulator._integrator, simulator._bound[0]
    loop, jacobian = integrator.batch, ((), ())
    if isinstance(loop, CvodeBatch):
        jacobian = loop.jacobian.states.tolist(), loop.jacobian.derivatives.tolist()
    hooks = no_hooks(len(points))
    expected = integrator.run(bound, points, hooks, bounds=bounds)
    found = integrator.run(
        bound, points, hooks, 0, lambda a: simulate(solver, a, jacobian=jacobian), bounds
    )
    np.testing.assert_array_equal(found.outputs, expected.outputs)
    np.testing.assert_array_equal(found.codes, expected.codes)
    np.testing.assert_array_equal(found.steps, expected.steps)
    assert found.messages == expected.messages
    simulator.close()
    return found


@pytest.mark.parametrize(("name", "fmi", "solver", "step"), CASES)
def test_every_loop_has_the_bits_of_the_compiled_one(own_fmu, name, fmi, solver, step):
    """Of FMUs with state, time and step events, discrete inputs, and of all types."""
    for kind in ("linear", "hold"):
        simulator = simulator_of(own_fmu(name, fmi), solver, step, kind=kind)
        compare(simulator, solver, np.zeros((2, 0)))


POINTS = np.array([[1.0, 25.0, 0.8], [1.1, 24.0, 0.7], [-1.0, 25.0, 0.8], [1.0, 20.0, 0.5]])


@pytest.mark.parametrize(("solver", "step"), HOWS)
def test_failures_and_bounds_end_a_simulation_where_they_did(solver, step):
    simulator = simulator_of(FMU, solver, step, ("m", "k", "c"))
    bounds = np.array([np.inf, 1e-3, np.inf, 1e-5])
    found = compare(simulator, solver, POINTS, bounds)
    assert found.codes[2] != 0


@pytest.mark.parametrize("solver", ["fmu", "rk4", "dormand_prince", "cvode"])
def test_a_failure_has_a_time_and_an_index(solver):
    simulator = simulator_of(FMU, solver, None, ("m", "k", "c"))
    seen = []

    def run(arguments):
        too_few = arguments._replace(settings=arguments.settings._replace(max_steps=0))
        made = core_batch(solver, too_few)
        if solver == "cvode":
            return simulate(solver, too_few)
        seen.append(made)
        return int(with_c_library().core_simulate(made.address))

    batch = simulator._integrator.run(simulator._bound[0], POINTS[:1], no_hooks(1), 0, run)
    assert batch.codes[0] == 5
    assert "model.max_steps" in batch.messages[0]
    assert all(made.indices[0] == 0 for made in seen)
    simulator.close()


def test_a_failure_between_two_times_of_the_grid_is_at_its_step(own_fmu):
    found = compare(simulator_of(own_fmu("robertson", 2), "rk4", 0.01), "rk4", np.zeros((1, 0)))
    assert found.codes[0] == 2
    assert "t = 0.02 s" in found.messages[0]


def test_sizes_that_do_not_fit_are_refused():
    simulator = simulator_of(FMU, "rk4", None, ("m", "k", "c"))

    def run(arguments):
        made = core_batch("rk4", arguments)
        made.batch.n_states = 7
        tried = int(with_c_library().core_simulate(made.address))
        assert arguments.codes[0] == WRONG_SIZES
        arguments.codes[0] = 1
        return tried

    simulator._integrator.run(simulator._bound[0], POINTS[:1], no_hooks(1), 0, run)
    simulator.close()
