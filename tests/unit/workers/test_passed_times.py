"""Steps pass over times at which outputs were measured between the samples of the inputs."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import FMU

from workers.core.failure import ENDED_EARLY
from workers.fmu.description import describe_model
from workers.grid import build_grid
from workers.messages import Effect, Experiment, FloatArray, Input, Model, Output, Solver
from workers.simulation.simulator import Simulator

SAMPLED = np.linspace(0.0, 4.0, 81)
BESIDE = np.clip(SAMPLED + 0.015 * np.sin(40.0 * SAMPLED), 0.0, 4.0)
FORCE = np.cos(3.0 * SAMPLED)
EFFECTS = {
    "none": ((), []),
    "drag": ((Effect("e", "der(v)", "quadratic"),), [-0.3]),
    "lag of the input": ((Effect("e", "input F", "lag"),), [0.2]),
}


def experiment(times: FloatArray, knots: FloatArray = SAMPLED) -> Experiment:
    """The same course of the input, whatever its samples are."""
    force = Input("F", knots, np.interp(knots, SAMPLED, FORCE))
    return Experiment("e", 0.0, 4.0, (force,), (Output("y", times, 0.0 * times, 1.0),))


def simulator(run: Experiment) -> Simulator:
    model = Model(
        "spring", FMU.read_bytes(), "model_exchange", Solver("dormand_prince", rtol=1e-8), ()
    )
    made = Simulator(model, describe_model(model), (run,))
    made.load()
    return made


def outputs(run: Experiment, effects: str) -> tuple[FloatArray, int]:
    """Outputs at measured times, and the steps of the solver."""
    added, values = EFFECTS[effects]
    made = simulator(run)
    found = made.run(0, np.array([values]).reshape(1, -1), added)
    assert found.messages == [""]
    grid = made.bound_experiment(0).grid
    return found.outputs[0].ravel()[grid.gather], int(found.steps[0])


@pytest.mark.parametrize("effects", EFFECTS)
def test_what_is_passed_over_is_as_exact_as_the_solver(effects):
    knots = np.union1d(SAMPLED, BESIDE)
    expected, most = outputs(experiment(BESIDE, knots), effects)
    found, steps = outputs(experiment(BESIDE), effects)
    np.testing.assert_allclose(found, expected, atol=2e-7 * np.abs(expected).max())
    assert steps < 0.8 * most


def test_a_simulation_that_ends_early_counts_what_it_passes():
    run = experiment(BESIDE)
    wrong = [replace(o, values=np.where(o.times > 2.0, 1e3, 0.0)) for o in run.outputs]
    made = simulator(replace(run, outputs=tuple(wrong)))
    found = made.run(0, np.zeros((1, 0)), bounds=np.array([1e4]))
    assert found.codes[0] == ENDED_EARLY


def test_only_what_lies_between_samples_is_passed():
    grid = build_grid(experiment(BESIDE))
    assert not np.isin(grid.times[grid.passed], SAMPLED).any()
    assert grid.passed.sum() == len(np.setdiff1d(BESIDE, SAMPLED))
    assert not build_grid(experiment(SAMPLED)).passed.any()


def test_sparse_inputs_leave_steps_as_they_are():
    ends = np.array([0.0, 4.0])
    assert not build_grid(experiment(BESIDE, ends)).passed.any()


def test_a_time_that_is_hardly_later_than_a_sample_is_no_measure_of_a_slope():
    assert not build_grid(experiment(SAMPLED[:-1] + 1e-12)).passed.any()
