"""Errors at the start of a record: a wrong initial state, or a sensor that has to settle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.results.initial_errors import InitialError, _settling, initial_errors, start_advice
from cluster_est.results.output_errors import Simulation
from workers.messages import Outcome, Status, Trajectory

TIMES = 0.01 * np.arange(600)
SIGMA = {"y": 0.002, "v": 0.01}
STIFF = TRUE | {"c": 30.0}  # overdamped, so that a wrong initial state only decays


def states(values, *, x0=0.0, v0=0.0):
    """Position and velocity of a spring with a held force, from matrix exponentials: (n, 2)."""
    force = np.where(TIMES < 0.1, 0.0, 3.0 * np.sin(2.0 * np.floor(TIMES / 0.2)))
    m, k, c = values["m"], values["k"], values["c"]
    forward = expm(0.01 * np.array([[0, 1, 0], [-k / m, -c / m, 1 / m], [0, 0, 0]]))
    path = np.zeros((len(TIMES), 3))
    path[0] = x0, v0, force[0]
    for i in range(1, len(TIMES)):
        path[i] = forward @ [*path[i - 1, :2], force[i - 1]]
    return path[:, :2]


def found(measured, simulated, *, outputs=("y", "v"), fitted=True):
    """The errors at the start of one experiment, with noise on what is measured."""
    noise = np.random.default_rng(3).normal(size=measured.shape)
    seen = [
        ce.Output(name, TIMES, measured[:, i] + SIGMA[name] * noise[:, i], sigma=SIGMA[name])
        for i, name in enumerate(("y", "v"))
        if name in outputs
    ]
    own = spring_problem(experiments=1).problem
    (run,) = own.experiments
    run = replace(run, stop=float(TIMES[-1]), outputs=tuple(seen))
    known = tuple(p for p in own.parameters if not p.per)
    model = replace(own.model, parameters=tuple(p.target for p in known))
    problem = replace(own, model=model, parameters=known, experiments=(run,))
    outcome = Outcome(0, Status.OK, trajectory=Trajectory(("y", "v"), TIMES, simulated))
    return problem, initial_errors(problem, [Simulation(0, outcome)], fitted=fitted)


def settling(size, tau, output=0):
    """The error of a sensor that has to settle."""
    error = np.zeros((len(TIMES), 2))
    error[:, output] = size * np.exp(-TIMES / tau)
    return error


@pytest.mark.parametrize("output", [0, 1])
@pytest.mark.parametrize("tau", [0.03, 0.1, 0.2])
@pytest.mark.parametrize("start", [TRUE, TRUE | {"k": 33.0, "c": 0.8}])
def test_a_sensor_that_settles_is_named_with_a_time_after_which_it_has(start, tau, output):
    size = 150.0 * list(SIGMA.values())[output]
    measured = states(TRUE) + settling(size, tau, output)
    problem, (error, *more) = found(measured, states(start), fitted=start is TRUE)
    assert more == []
    name, other = ("y", "v")[output], ("v", "y")[output]
    assert (error.output, error.others) == (name, (other,))
    left = size * np.exp(-error.settling / tau) / SIGMA[name]
    assert 0.05 < left < 1.0
    assert f"only {name} differs from the model" in error.sentence
    assert f"while {other} fits from the first sample" in error.sentence
    assert f"warm_up = {error.settling:g} in experiment_defaults" in start_advice(problem, error)


@pytest.mark.parametrize("seed", range(5))
def test_an_error_that_is_no_larger_at_the_start_does_not_settle(seed):
    """Nearly the largest of later errors: its decay would be extrapolated backwards."""
    sigma = SIGMA["y"]
    errors = sigma * np.random.default_rng(seed).standard_normal(400)
    errors[0] = 1.75 * sigma
    output = ce.Output("y", np.arange(400.0), np.zeros(400), sigma=sigma)
    assert all(time >= 0.0 for time in _settling(output, errors))


@pytest.mark.parametrize("fitted", [True, False])
@pytest.mark.parametrize("values", [TRUE, STIFF])
@pytest.mark.parametrize(("x0", "v0"), [(0.3, 0.0), (-0.2, 0.0), (0.0, 2.0), (0.3, 1.0)])
def test_a_wrong_initial_state_is_not_called_a_sensor(values, x0, v0, fitted):
    problem, errors = found(states(values, x0=x0, v0=v0), states(values), fitted=fitted)
    assert errors
    for error in errors:
        assert error.settling == 0.0
        assert "begins in a different state from the model" in error.sentence
        assert start_advice(problem, error).startswith("estimate the initial states")


@pytest.mark.parametrize(
    ("error", "outputs"),
    [
        (settling(0.3, 0.1), ("y",)),  # no other output shows that the states are right
        (settling(0.3, 0.1) + settling(1.5, 0.1, 1), ("y", "v")),
        (settling(0.3, 2.0), ("y", "v")),  # too slow for a sensor
    ],
)
def test_no_sensor_is_named_without_another_output_that_fits(error, outputs):
    _, errors = found(states(TRUE) + error, states(TRUE), outputs=outputs)
    assert [each.settling for each in errors] == [0.0] * len(errors)


def test_sentence_on_several_outputs_and_experiments():
    error = InitialError("y", "m", 0.03, 40.0, 3, 4, 0.8, ("v", "w"))
    assert error.sentence == (
        "at the start of 3 of 4 experiments, only y differs from the model: at the first sample, "
        "it is off by up to 0.03 m, 40 times its noise, and this error decays within about 0.8 s, "
        "while v and w fit from the first sample"
    )
