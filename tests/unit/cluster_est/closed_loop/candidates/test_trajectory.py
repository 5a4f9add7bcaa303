"""What a simulated experiment offers to effects, and where its residuals stand."""

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est import Parameter
from cluster_est.closed_loop.candidates.trajectory import pooled
from workers.messages import Effect, Input, Output


def courses_of(problem):
    with opened(problem) as bench:
        return bench.trajectories(unfitted(bench))


@pytest.fixture(scope="module")
def uneven():
    """Two outputs of different sampling, the second measured at a few times only."""
    problem = missing_effect_problem("two_mass_drive")
    times = np.array([0.1234, 0.5, 2.71])
    runs = []
    for run in problem.experiments:
        first, second = run.outputs
        second = Output(second.variable, times, np.zeros(3), second.sigma)
        runs.append(replace(run, outputs=(first, second)))
    problem = replace(problem, experiments=tuple(runs))
    return problem, courses_of(problem)


def test_residuals_are_measured_less_simulated_over_sigma(uneven):
    problem, (course, _) = uneven
    change = np.zeros((*course.outputs.shape, 1))
    change[:, 0, 0] = course.times
    change[:, 1, 0] = 100.0 + course.times
    first, second = problem.experiments[0].outputs
    expected = [-first.times / first.sigma, -(100.0 + second.times) / second.sigma]
    found = course.residual_change(change)
    np.testing.assert_allclose(found[:, 0], np.concatenate(expected), rtol=1e-14)


def test_states_inputs_measured_signals_and_outputs_have_names(uneven):
    problem, (course, other) = uneven
    names = {"twist", "w_motor", "w_load", "torque", "extra", "motor_speed", "load_speed"}
    assert set(course.signals) == names
    given = problem.experiments[0].inputs[0]
    at = np.searchsorted(course.times, given.times)
    np.testing.assert_allclose(course.signal("torque")[at], given.values, rtol=1e-13)
    gap = course.signal("w_motor") - course.signal("w_load")
    np.testing.assert_array_equal(course.signal("w_motor - w_load"), gap)
    assert course.has("w_motor - w_load")
    assert not course.has("w_motor - speed")
    both = pooled([course, other], "extra")
    np.testing.assert_array_equal(both, [*course.signal("extra"), *other.signal("extra")])


def test_states_that_effects_bring_are_nothing_to_depend_on():
    problem = missing_effect_problem("mass_spring_damper")
    with opened(problem) as bench:
        start = unfitted(bench).start
        lagged = Effect("lag", "input F", "lag")
        tau = Parameter("lag.tau", 0.1, 0.01, 1.0)
        grown = replace(problem, effects=(lagged,), parameters=(*problem.parameters, tau))
        courses = bench.trajectories(unfitted(bench, replace(start, problem=grown)))
    assert set(courses[0].signals) == {"x", "v", "F", "extra", "y"}
    assert np.abs(courses[0].signal("F") - problem.experiments[0].inputs[0].values).max() > 0.1


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_what_is_held_keeps_its_value_until_the_next_sample(interface):
    problem = missing_effect_problem("battery", interface=interface)
    steps = np.array([0.0, 600.0, 1300.0])
    held = Input("current", steps, np.array([1.0, 2.0, -1.0]), "hold")
    warm = Input("extra", steps, np.array([20.0, 30.0, 40.0]), "hold")
    run = replace(problem.experiments[0], inputs=(held,), signals=(warm,))
    (course,) = courses_of(replace(problem, experiments=(run,)))
    expected = np.where(course.times < 600.0, 1.0, np.where(course.times < 1300.0, 2.0, -1.0))
    np.testing.assert_array_equal(course.signal("current"), expected)
    np.testing.assert_array_equal(course.signal("extra"), 10.0 * np.digitize(course.times, steps)
                                  + 10.0)  # fmt: skip
