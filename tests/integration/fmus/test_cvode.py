"""CVODE on stiff models, against SciPy on the same equations; and that it leaves no trace."""

import gc
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import FMU
from support.simulated import answer
from support.truth.own_fmus import fed, oscillation, reaction, robertson, van_der_pol

from cluster_est import Experiment, Input, Output, Parameter, Problem, Solver, fit
from workers.evaluate import Evaluator
from workers.messages import Effect, Model, Status, Task
from workers.probes.probes import StiffnessProbe
from workers.wire import TaskBatch

TOLERANCES = (1e-5, 1e-7, 1e-9)
ONE = np.array([[1.0]])
NOTHING = np.zeros((1, 0))
FREE = oscillation(np.linspace(0.0, 20.0, 61))


@pytest.fixture
def opened(built_fmu):
    """Open test models, and close them in the end."""
    made = []

    def give(name, experiment, rtol=1e-8, parameters=(), solver="cvode", **options):
        chosen = Solver(solver, rtol=rtol, **options)
        archive = built_fmu(name)
        model = Model(f"{name}.fmu", archive, "model_exchange", chosen, parameters)
        made.append(Evaluator(model, (experiment,), "w"))
        return made[-1]

    yield give
    for each in made:
        each.close()


def oscillator(opened, rtol=1e-8, experiment=FREE, **options):
    return opened("van_der_pol_stiff", experiment, rtol, ("mu",), **options)


def run(evaluator, points):
    tasks = [Task(i, 0, point, "trajectory") for i, point in enumerate(points)]
    return evaluator.evaluate(TaskBatch.of(tasks))


def outputs(evaluator, points=NOTHING):
    """(points, times, outputs) of simulations that must succeed."""
    outcomes = run(evaluator, points)
    assert {outcome.message for outcome in outcomes} == {""}
    return np.array([outcome.trajectory.values for outcome in outcomes])


def bits(outcome):
    return outcome.ok and outcome.trajectory.values.tobytes()


@cache
def truth(mu, stop):
    return van_der_pol(np.linspace(0.0, stop, 61), mu)[:, 0]


@pytest.mark.parametrize(
    ("mu", "stop", "bar"),
    [(1.0, 20.0, 2e3), pytest.param(1000.0, 2000.0, 5e3, marks=pytest.mark.slow)],
)
def test_errors_shrink_with_the_tolerance(opened, mu, stop, bar):
    """Backward differences meet a tolerance in each step; over many, errors add up."""
    free = oscillation(np.linspace(0.0, stop, 61))
    found = [outputs(oscillator(opened, rtol, free), np.array([[mu]])) for rtol in TOLERANCES]
    errors = [np.abs(each[0, :, 0] - truth(mu, stop)).max() for each in found]
    assert errors == sorted(errors, reverse=True)
    assert all(error < bar * rtol for error, rtol in zip(errors, TOLERANCES, strict=True))


@cache
def reacted(interpolation):
    return reaction(fed(interpolation))[1]


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_sampled_inputs_with_kinks_and_jumps(opened, interpolation):
    expected = reacted(interpolation)
    errors = []
    for rtol in TOLERANCES:
        found = outputs(opened("robertson_fed", fed(interpolation), rtol))[0]
        errors.append((np.abs(found - expected).max(axis=0) / expected.max(axis=0)).max())
    assert errors == sorted(errors, reverse=True)
    assert all(error < 300 * rtol for error, rtol in zip(errors, TOLERANCES, strict=True))


@pytest.mark.parametrize("interpolation", ["linear", pytest.param("hold", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_pulse_much_shorter_than_a_step_is_not_missed(opened, interpolation):
    knots = np.array([0.0, 900.0, 900.5, 901.0, 1000.0])
    pulse = Input("feed", knots, np.array([0.0, 0.0, 1.0, 0.0, 0.0]), interpolation)
    times = np.array([500.0, 900.4, 901.0, 905.0, 930.0])
    measured = tuple(Output(name, times, 0 * times) for name in ("y_a", "y_b"))
    pulsed = Experiment("pulse", 0.0, 1000.0, (pulse,), measured)
    found = outputs(opened("robertson_fed", pulsed, 1e-8))[0]
    _, expected = reaction(pulsed)
    np.testing.assert_allclose(found[-5:], expected[-5:], atol=2e-6)
    assert expected[:, 0][-4] > 0.1


def test_edges_of_an_input_may_be_a_rounding_error_apart(opened):
    edge = np.nextafter(10.0, 20.0)
    knots, values = np.array([0.0, 10.0, edge, 40.0]), np.array([0.0, 0.0, 0.2, 0.2])
    for interpolation in ("linear", "hold"):
        stepped = Experiment(
            "edge", 0.0, 40.0, (Input("feed", knots, values, interpolation),),
            (Output("y_a", np.array([40.0]), np.zeros(1)),),
        )  # fmt: skip
        steep = outputs(opened("robertson_fed", stepped))[0, -1, 0]
        clean = Input("feed", np.array([0.0, 10.0]), np.array([0.0, 0.2]), "hold")
        alone = Experiment("clean", 0.0, 40.0, (clean,), stepped.outputs)
        smooth = outputs(opened("robertson_fed", alone))[0, -1, 0]
        assert steep == pytest.approx(smooth, abs=1e-6)


def test_longest_step_and_limit_of_steps(opened):
    how = {"experiment": oscillation(np.array([0.0, 20.0])), "step": 0.1}
    (outcome,) = run(oscillator(opened, 1e-4, max_steps=400, **how), ONE)
    assert outcome.ok
    (outcome,) = run(oscillator(opened, 1e-4, max_steps=190, **how), ONE)
    assert "data exceeded model.max_steps at t = 1" in outcome.message
    assert "stiff" not in outcome.message


TIMES = np.linspace(0.0, 4.0, 101)
EFFECTS = {
    "friction": (Effect("e", "der(v)", "dahl"), (0.5, 0.02)),
    "input": (Effect("e", "input F", "square"), (0.1,)),
    "parameter": (Effect("e", "parameter k", "drift"), (0.3, 1.0)),
    "lag": (Effect("e", "output y", "lag"), (0.05,)),
}


@pytest.mark.parametrize(
    ("name", "interpolation"), [*zip(EFFECTS, ("linear", "hold", "hold", "linear"), strict=True)]
)
def test_effects_act_as_with_dormand_prince(name, interpolation):
    effect, coefficients = EFFECTS[name]
    force = Input("F", TIMES, 3.0 * np.sin(5.0 * TIMES), interpolation)
    driven = Experiment("e", 0.0, 4.0, (force,), (Output("y", TIMES, 0 * TIMES),), {"x": 0.1})
    found = []
    for solver in (Solver("dormand_prince", rtol=1e-10), Solver("cvode", rtol=1e-10)):
        model = Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ("m", "k", "c"))
        values = [1.2, 30.0, 0.6, *coefficients]
        outcome = answer(model, driven, values, "trajectory", (effect,))
        assert outcome.ok, outcome.message
        found.append(outcome.trajectory.values)
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)


def test_same_bits_whatever_ran_before(opened):
    points = np.array([[1.0], [1000.0], [5.0], [np.nan], [0.3]])
    used, *new = (oscillator(opened, max_steps=2000) for _ in range(6))
    alone = [bits(run(each, point[None])[0]) for each, point in zip(new, points, strict=True)]
    assert [each is False for each in alone] == [False, False, False, True, False]
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [3, 3, 0, 2, 2]):
        assert [bits(each) for each in run(used, points[order])] == [alone[i] for i in order]


def test_integrators_in_several_threads_do_not_disturb_each_other(opened):
    points = np.linspace(1.0, 50.0, 40)[:, None]
    several = [oscillator(opened) for _ in range(3)]
    expected = outputs(oscillator(opened), points).tobytes()
    with ThreadPoolExecutor(3) as pool:
        for _ in range(3):
            for found in pool.map(lambda each: outputs(each, points), several):
                assert found.tobytes() == expected


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.parametrize(
    ("name", "fmi"),
    [
        ("robertson", 2),
        ("wrong_directional", 2),
        pytest.param("wrong_directional", 3, marks=pytest.mark.slow),
        ("zero_directional", 2),
    ],
)
def test_the_fmus_jacobian_is_not_trusted_unseen(own_fmu, name, fmi):
    """With a wrong one it would take steps as short as an explicit solver's, or fail."""
    archive, times = own_fmu(name, fmi), np.linspace(0.0, 2.0, 11)
    output = Output("A" if name == "robertson" else "x", times, np.zeros(11))
    solver = Solver("cvode", rtol=1e-8)
    model = Model(archive.name, archive.read_bytes(), "model_exchange", solver, ())
    found = -answer(model, Experiment("e", 0.0, 2.0, (), (output,))).residuals
    expected = robertson(times)[:, 0] if name == "robertson" else np.exp(-times)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.slow
def test_memory_does_not_grow(opened):
    asked = oscillator(opened, 1e-4, oscillation(np.linspace(0.0, 1.0, 3)))
    points = np.concatenate([np.tile([[1.0], [2.0]], (500, 1)), np.full((50, 1), np.nan)])
    run(asked, points)
    growths = []
    for _ in range(3):
        before = resident()
        for _ in range(6):
            run(asked, points)
        gc.collect()
        growths.append(resident() - before)
    # Other threads of the process may take memory in between, but not each time.
    assert min(growths) < 2**20


def test_failures_are_sentences_and_nothing_is_printed(opened, capfd):
    long = oscillation(np.linspace(0.0, 2000.0, 11))
    for rtol, mu, reason in (
        (1e-8, 1e300, "the FMU could not continue"),
        (1e-300, 1.0, "did not meet the tolerance"),
    ):
        (outcome,) = run(oscillator(opened, rtol, long), np.array([[mu]]))
        assert outcome.status is Status.SOLVER_FAILURE
        assert f"{reason} at t = " in outcome.message
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


WITHOUT = """
import sys
sys.modules["fmpy.sundials"] = None
import cluster_est as ce
from workers.evaluate import Evaluator
try:
    model = ce.read_model(sys.argv[1], solver=ce.Solver("cvode"))
    Evaluator(model, [ce.Experiment("e", 0.0, 1.0, (), (ce.Output("y", [1.0], [0.0]),))], "w")
except ce.ClusterEstError as error:
    print(error)
"""


def test_where_there_are_no_libraries_a_sentence_says_so():
    command = [sys.executable, "-c", WITHOUT, str(FMU)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert re.search(r"model.solver: .*choose dormand_prince or rk4", ended.stdout)


def test_explicit_solver_recommends_it(opened):
    long = oscillation(np.linspace(0.0, 2000.0, 11))
    explicit = oscillator(opened, experiment=long, solver="dormand_prince", max_steps=1000)
    (outcome,) = run(explicit, np.array([[1000.0]]))
    assert 'if the model is stiff, set model.solver = "cvode"' in outcome.message


@pytest.mark.parametrize("rtol", [1e-4, pytest.param(1e-8, marks=pytest.mark.slow)])
def test_stiffness_is_told(opened, rtol):
    def stiff(evaluator, *point):
        return StiffnessProbe(0, np.array(point)).answer(evaluator)

    for mu, stop, expected in ((1.0, 20.0, False), (1e-3, 20.0, False), (1000.0, 2000.0, True)):
        oscillating = oscillation(np.linspace(0.0, stop, 21))
        for solver in ("dormand_prince", "cvode"):
            assert stiff(oscillator(opened, rtol, oscillating, solver=solver), mu) is expected
    assert stiff(opened("robertson_fed", fed("linear"), rtol))
    assert not stiff(oscillator(opened, rtol), np.nan)


def test_a_stiff_model_is_fitted(built_fmu):
    """The steps of difference quotients suit the noise of this solver."""
    driven = fed("linear")
    times, clean = reaction(driven)
    measured = tuple(
        replace(output, values=clean[np.searchsorted(times, output.times), place], sigma=sigma)
        for place, (output, sigma) in enumerate(zip(driven.outputs, (1e-2, 1e-6), strict=True))
    )
    names = ("k1", "k3", "drain")
    model = Model("r", built_fmu("robertson_fed"), "model_exchange", Solver("cvode"), names)
    parameters = (
        Parameter("k1", 0.1, (1e-3, 1.0), scale="log"),
        Parameter("k3", 3e3, (1e2, 1e6), scale="log"),
        Parameter("drain", 0.05, (0.0, 1.0)),
    )
    result = fit(Problem(model, parameters, (replace(driven, outputs=measured),)))
    found = [estimate.value for estimate in result.estimates]
    np.testing.assert_allclose(found, [0.04, 1e4, 0.1], rtol=1e-5)
