"""CVODE on stiff models, against SciPy on the same equations; and that it leaves no trace."""

from __future__ import annotations

import gc
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import FMU
from support.truth.own_fmus import robertson
from support.truth.stiff_models import fed, oscillation, reaction, van_der_pol

from cluster_est import Experiment, Input, Output, Parameter, Problem, Solver, fit
from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.fmu.description import describe
from workers.kernels.solvers import sundials
from workers.messages import Effect, Model, Status, Task
from workers.simulation.simulator import Simulator
from workers.wire import TaskBatch

TOLERANCES = (1e-5, 1e-7, 1e-9)
ONE = np.array([[1.0]])
STIFF = np.array([[1000.0]])
FREE = oscillation(np.linspace(0.0, 20.0, 61))


@pytest.fixture
def simulator(built_fmu):
    """Make simulators of a test model, and free them in the end."""
    made = []

    def make(name, experiment, rtol=1e-8, parameters=(), solver="cvode", **options):
        archive = built_fmu(name)
        chosen = Solver(solver, rtol=rtol, **options)
        model = Model(f"{name}.fmu", archive, "model_exchange", chosen, parameters)
        made.append(Simulator(model, describe(f"{name}.fmu", archive), (experiment,)))
        made[-1].load()
        return made[-1]

    yield make
    for each in made:
        each.close()


def oscillator(simulator, rtol=1e-8, experiment=FREE, **options):
    return simulator("van_der_pol_stiff", experiment, rtol, ("mu",), **options)


def outputs(simulated, points):
    record = simulated.run(0, points)
    assert set(record.messages) == {""}
    return record.outputs


@cache
def truth(mu, stop):
    return van_der_pol(mu, np.linspace(0.0, stop, 61))


@pytest.mark.parametrize(("mu", "stop", "bar"), [(1.0, 20.0, 2e3), (1000.0, 2000.0, 5e3)])
def test_errors_shrink_with_the_tolerance(simulator, mu, stop, bar):
    """Backward differences meet a tolerance in each step; over many, errors add up."""
    run = oscillation(np.linspace(0.0, stop, 61))
    found = [outputs(oscillator(simulator, rtol, run), np.array([[mu]])) for rtol in TOLERANCES]
    errors = [np.abs(each[0, :, 0] - truth(mu, stop)).max() for each in found]
    assert errors == sorted(errors, reverse=True)
    assert all(error < bar * rtol for error, rtol in zip(errors, TOLERANCES, strict=True))


@cache
def reacted(interpolation):
    return reaction(fed(interpolation))[1]


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_sampled_inputs_with_kinks_and_jumps(simulator, interpolation):
    expected = reacted(interpolation)
    errors = []
    for rtol in TOLERANCES:
        found = outputs(simulator("robertson_fed", fed(interpolation), rtol), np.zeros((1, 0)))[0]
        errors.append((np.abs(found - expected).max(axis=0) / expected.max(axis=0)).max())
    assert errors == sorted(errors, reverse=True)
    assert all(error < 300 * rtol for error, rtol in zip(errors, TOLERANCES, strict=True))


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_a_pulse_much_shorter_than_a_step_is_not_missed(simulator, interpolation):
    knots = np.array([0.0, 900.0, 900.5, 901.0, 1000.0])
    pulse = Input("feed", knots, np.array([0.0, 0.0, 1.0, 0.0, 0.0]), interpolation)
    times = np.array([500.0, 900.4, 901.0, 905.0, 930.0])
    measured = tuple(Output(name, times, 0 * times) for name in ("y_a", "y_b"))
    run = Experiment("pulse", 0.0, 1000.0, (pulse,), measured)
    found = outputs(simulator("robertson_fed", run, 1e-8), np.zeros((1, 0)))[0]
    _, expected = reaction(run)
    np.testing.assert_allclose(found[-5:], expected[-5:], atol=2e-6)
    assert expected[:, 0][-4] > 0.1


def test_edges_of_an_input_may_be_a_rounding_error_apart(simulator):
    edge = np.nextafter(10.0, 20.0)
    knots, values = np.array([0.0, 10.0, edge, 40.0]), np.array([0.0, 0.0, 0.2, 0.2])
    for interpolation in ("linear", "hold"):
        run = Experiment(
            "edge", 0.0, 40.0, (Input("feed", knots, values, interpolation),),
            (Output("y_a", np.array([40.0]), np.zeros(1)),),
        )  # fmt: skip
        steep = outputs(simulator("robertson_fed", run), np.zeros((1, 0)))[0, -1, 0]
        clean = Input("feed", np.array([0.0, 10.0]), np.array([0.0, 0.2]), "hold")
        alone = Experiment("clean", 0.0, 40.0, (clean,), run.outputs)
        smooth = outputs(simulator("robertson_fed", alone), np.zeros((1, 0)))[0, -1, 0]
        assert steep == pytest.approx(smooth, abs=1e-6)


def test_longest_step_and_limit_of_steps(simulator):
    assert oscillator(simulator, 1e-4, step=0.1, max_steps=400).run(0, ONE).messages == [""]
    (message,) = oscillator(simulator, 1e-4, step=0.1, max_steps=190).run(0, ONE).messages
    assert message.startswith("the limit on the number of steps was reached at t = 1")
    assert "stiff" not in message


TIMES = np.linspace(0.0, 4.0, 101)
EFFECTS = {
    "friction": (Effect("e", "der(v)", "dahl"), (0.5, 0.02)),
    "input": (Effect("e", "input F", "square"), (0.1,)),
    "parameter": (Effect("e", "parameter k", "drift"), (0.3,)),
    "lag": (Effect("e", "output y", "lag"), (0.05,)),
}


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_effects_act_as_with_dormand_prince(name, interpolation):
    effect, coefficients = EFFECTS[name]
    force = Input("F", TIMES, 3.0 * np.sin(5.0 * TIMES), interpolation)
    run = Experiment("e", 0.0, 4.0, (force,), (Output("y", TIMES, 0 * TIMES),), (("x", 0.1),))
    found = []
    for solver in (Solver("dormand_prince", rtol=1e-10), Solver("cvode", rtol=1e-10)):
        model = Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ("m", "k", "c"))
        evaluator = Evaluator(model, (run,), "w")
        values = np.array([1.2, 30.0, 0.6, *coefficients])
        (outcome,) = evaluator.evaluate(TaskBatch.of([Task(0, 0, values, "trajectory", (effect,))]))
        evaluator.close()
        assert outcome.ok, outcome.message
        found.append(outcome.trajectory.values)
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)


def test_same_bits_whatever_ran_before(simulator):
    used = oscillator(simulator, max_steps=2000)
    points = np.array([[1.0], [1000.0], [5.0], [np.nan], [0.3]])
    alone = [oscillator(simulator, max_steps=2000).run(0, point[None]).outputs for point in points]
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [3, 3, 0, 2, 2]):
        together = used.run(0, points[order])
        assert [bool(m) for m in together.messages] == [place == 3 for place in order]
        for row, place in enumerate(order):
            assert together.outputs[row].tobytes() == alone[place].tobytes()


def test_integrators_in_several_threads_do_not_disturb_each_other(simulator):
    points = np.linspace(1.0, 50.0, 40)[:, None]
    several = [oscillator(simulator) for _ in range(3)]
    expected = outputs(oscillator(simulator), points).tobytes()
    with ThreadPoolExecutor(3) as pool:
        for _ in range(3):
            for found in pool.map(lambda each: each.run(0, points), several):
                assert found.outputs.tobytes() == expected


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(
    ("name", "right"),
    [("robertson", True), ("wrong_directional", False), ("zero_directional", False)],
)
def test_the_jacobian_is_the_fmus_if_that_is_right(own_fmu, name, right, fmi):
    archive = own_fmu(name, fmi)
    content = archive.read_bytes()
    model = Model(archive.name, content, "model_exchange", Solver("cvode", rtol=1e-8), ())
    times = np.linspace(0.0, 2.0, 11)
    output = Output("A" if right else "x", times, np.zeros(11), 1.0)
    simulated = Simulator(
        model, describe(archive.name, content), (Experiment("e", 0.0, 2.0, (), (output,)),)
    )
    simulated.load()
    found = outputs(simulated, np.zeros((1, 0)))[0, :, 0]
    expected = robertson(times)[:, 0] if right else np.exp(-times)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert simulated.gives_jacobian == right
    simulated.close()


def test_memory_does_not_grow(simulator):
    short = oscillation(np.linspace(0.0, 1.0, 3))
    simulated = oscillator(simulator, 1e-4, short)
    points = np.tile([[1.0], [2.0]], (500, 1))
    failing = np.full((50, 1), np.nan)
    simulated.run(0, points)
    growths = []
    for _ in range(3):
        before = resident()
        for _ in range(10):
            simulated.run(0, points)
            simulated.run(0, failing)
        for _ in range(1000):
            sundials.CvodeIntegrator(20)
        gc.collect()
        growths.append(resident() - before)
    # Other threads of the process may take memory in between, but not each time.
    assert min(growths) < 2**20


def test_failures_are_sentences_and_nothing_is_printed(simulator, capfd):
    run = oscillation(np.linspace(0.0, 2000.0, 11))
    for rtol, mu, reason in (
        (1e-8, 1e300, "the FMU could not go on"),
        (1e-300, 1.0, "no step was short enough for the tolerance"),
    ):
        (message,) = oscillator(simulator, rtol, run).run(0, np.array([[mu]])).messages
        assert message.startswith(f"{reason} at t = ")
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_where_there_are_no_libraries_a_sentence_says_so(simulator, monkeypatch):
    sundials.libraries.cache_clear()
    monkeypatch.setitem(sys.modules, "fmpy.sundials", None)
    try:
        with pytest.raises(ModelError, match=r"model.solver: .*choose dormand_prince or rk4"):
            oscillator(simulator)
    finally:
        sundials.libraries.cache_clear()


def test_explicit_solver_recommends_it(simulator):
    run = oscillation(np.linspace(0.0, 2000.0, 11))
    explicit = oscillator(simulator, experiment=run, solver="dormand_prince", max_steps=1000)
    record = explicit.run(0, STIFF)
    assert record.messages[0].endswith('; if the model is stiff, model.solver = "cvode" goes on '
                                       "in long steps")  # fmt: skip


@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_stiffness_is_told(simulator, rtol):
    for mu, stop, stiff in ((1.0, 20.0, False), (1e-3, 20.0, False), (1000.0, 2000.0, True)):
        run = oscillation(np.linspace(0.0, stop, 21))
        for solver in ("dormand_prince", "cvode"):
            asked = oscillator(simulator, rtol, run, solver=solver)
            assert asked.is_stiff(0, np.array([mu])) is stiff
    assert simulator("robertson_fed", fed("linear"), rtol).is_stiff(0, np.zeros(0))
    assert not oscillator(simulator, rtol).is_stiff(0, np.array([np.nan]))


def test_a_stiff_model_is_fitted(built_fmu):
    """The steps of difference quotients suit the noise of this solver."""
    run = fed("linear")
    times, clean = reaction(run)
    measured = tuple(
        replace(output, values=clean[np.searchsorted(times, output.times), place], sigma=sigma)
        for place, (output, sigma) in enumerate(zip(run.outputs, (1e-2, 1e-6), strict=True))
    )
    names = ("k1", "k3", "drain")
    model = Model("r", built_fmu("robertson_fed"), "model_exchange", Solver("cvode"), names)
    parameters = (
        Parameter("k1", 0.1, 1e-3, 1.0, scale="log"),
        Parameter("k3", 3e3, 1e2, 1e6, scale="log"),
        Parameter("drain", 0.05, 0.0, 1.0),
    )
    result = fit(Problem(model, parameters, (replace(run, outputs=measured),)))
    found = [estimate.value for estimate in result.estimates]
    np.testing.assert_allclose(found, [0.04, 1e4, 0.1], rtol=1e-5)


def test_through_the_evaluator(built_fmu):
    """Residuals, and the end of a simulation that fails, as with any other solver."""
    model = Model("v", built_fmu("van_der_pol_stiff"), "model_exchange", Solver("cvode"), ("mu",))
    evaluator = Evaluator(model, (FREE,), "w")
    tasks = [Task(0, 0, ONE[0]), Task(1, 0, np.array([np.inf]))]
    good, bad = evaluator.evaluate(TaskBatch.of(tasks))
    evaluator.close()
    assert good.ok
    np.testing.assert_allclose(-good.residuals, truth(1.0, 20.0), atol=1e-5)
    assert bad.status is Status.SOLVER_FAILURE
