"""All loops against the models' equations, solved by SciPy to a thousandth of the bar."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.problems.driven_spring import model_of
from support.simulated import answer
from support.thinning import thinned
from support.truth.example_models import MODELS, REFERENCES, sampled_experiment, solve

from workers.messages import Experiment, Output, Solver, Status

STEPS = {name: reference.step for name, reference in REFERENCES.items() if reference.step}
LOOPS = ("dormand_prince", "rk4", "cvode", "fmu")


def simulate(name, experiment, solver):
    model = model_of(solver, (), MODELS / f"{name}.fmu")
    return answer(model, experiment, (), "trajectory")


@cache
def sampled(name, interpolation):
    """An experiment, all of its times, and the outputs there."""
    experiment = sampled_experiment(REFERENCES[name], interpolation)
    signals = [*experiment.inputs, *experiment.outputs]
    times = np.unique(np.concatenate([s.times for s in signals]))
    times = np.union1d([experiment.start, experiment.stop], times)
    times = times[(times >= experiment.start) & (times <= experiment.stop)]
    return experiment, times, solve(REFERENCES[name], experiment, times)


def relative_error(outcome, times, expected):
    """The largest error of any output, relative to the output's size."""
    assert outcome.trajectory is not None, outcome.message
    np.testing.assert_array_equal(outcome.trajectory.times, times)
    error = np.abs(outcome.trajectory.values - expected).max(axis=0)
    return float((error / np.abs(expected).max(axis=0)).max())


def on_grid(solver, name):
    """With a step that is short enough for this model, where the solver's own is not asked for."""
    step = None if solver == "dormand_prince" else STEPS[name]
    return Solver(solver, step, rtol=1e-10)


HOWS = [
    *((solver, None, 1e-8) for solver in LOOPS),
    ("dormand_prince", Solver("dormand_prince"), 1e-6),  # with the default tolerance
    ("fmu", Solver("fmu"), 5e-8),  # with the FMU's own steps
]


@pytest.mark.parametrize(
    ("name", "interpolation", "how"),
    thinned(
        [(name, kind, how) for how in HOWS for kind in ("linear", "hold") for name in STEPS],
        lambda name, *_: name,
        lambda _, kind, how: (kind, how[0]),
        lambda *given: given[-1],
    ),
    ids=str,
)
def test_every_loop_follows_the_equations(name, interpolation, how):
    """Inputs and outputs sampled unequally, off each other's times, from a start that is not 0."""
    solver, chosen, bar = how
    experiment, times, expected = sampled(name, interpolation)
    outcome = simulate(name, experiment, chosen or on_grid(solver, name))
    assert relative_error(outcome, times, expected) < bar


def free_run(times, stop):
    """The mass left to itself from t = 1: nothing but its outputs on the grid."""
    reference = replace(REFERENCES["mass_spring_damper"], inputs={})
    output = Output("y", np.array(times), np.zeros(len(times)))
    experiment = Experiment("free", 1.0, stop, (), (output,), reference.starts)
    rates = reference.rates
    still = replace(reference, rates=lambda x, u, p: rates(x, [0.0, *u], p))
    at = np.union1d([1.0, stop], times)
    return experiment, at, solve(still, experiment, at)


@pytest.mark.parametrize("solver", LOOPS)
@pytest.mark.parametrize(
    ("times", "stop"), [([1.0, 1.01, 5.0, 5.003, 9.0], 9.0), ([9.0], 9.0), ([1.0], 6.0)]
)
def test_long_gaps_between_measured_times_are_crossed_in_steps(solver, times, stop):
    experiment, at, expected = free_run(times, stop)
    step = None if solver == "dormand_prince" else 2e-3
    chosen = Solver(solver, step, rtol=1e-11)
    outcome = simulate("mass_spring_damper", experiment, chosen)
    assert relative_error(outcome, at, expected) < 1e-8


def ends(solver):
    """The mass left to itself over one interval of a second, in at most some steps."""
    return simulate("mass_spring_damper", free_run([2.0], 2.0)[0], solver)


@pytest.mark.parametrize("solver", ["rk4", "fmu"])
def test_fixed_steps_divide_an_interval_and_are_counted(solver):
    for step, enough in ((0.1, 10), (0.3, 4), (None, 1)):
        outcome = ends(Solver(solver, step, max_steps=enough))
        assert outcome.ok, outcome.message
        assert outcome.steps == enough
    for step, most in ((0.1, 9), (0.3, 3), (1e-12, 10**6), (1e-320, 10**6)):
        outcome = ends(Solver(solver, step, max_steps=most))
        assert outcome.status is Status.SOLVER_FAILURE
        assert "data exceeded model.max_steps at t = 1 s" in outcome.message


@pytest.mark.parametrize("solver", LOOPS)
def test_the_limit_of_steps_counts_anew_at_each_time_in_the_data(solver):
    experiment, at, expected = free_run(np.linspace(1.1, 9.0, 80), 9.0)
    chosen = Solver(solver, 0.01, rtol=1e-6, max_steps=40)
    outcome = simulate("mass_spring_damper", experiment, chosen)
    assert relative_error(outcome, at, expected) < 2e-2
    assert outcome.steps >= 800


def test_dormand_prince_obeys_its_longest_step():
    loose = {"rtol": 0.99, "atol": 1.0}
    assert ends(Solver("dormand_prince", max_steps=12, **loose)).ok
    assert not ends(Solver("dormand_prince", 0.01, max_steps=99, **loose)).ok
    assert ends(Solver("dormand_prince", 0.01, max_steps=112, **loose)).ok
    experiment, at, expected = free_run([2.0], 2.0)
    outcome = simulate("mass_spring_damper", experiment, Solver("dormand_prince", 0.005, **loose))
    assert relative_error(outcome, at, expected) < 1e-8


def test_dormand_prince_meets_any_tolerance_it_is_given():
    experiment, times, expected = sampled("mass_spring_damper", "linear")
    solvers = [Solver("dormand_prince", rtol=rtol) for rtol in (1e-5, 1e-7, 1e-9, 1e-11)]
    outcomes = [simulate("mass_spring_damper", experiment, solver) for solver in solvers]
    errors = [relative_error(outcome, times, expected) for outcome in outcomes]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-10
