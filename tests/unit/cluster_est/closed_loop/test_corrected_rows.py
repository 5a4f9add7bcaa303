"""Thinned records as a loop looks at them."""

from dataclasses import replace

import numpy as np
from support.problems.springs import ROOT

from cluster_est import Experiment, Input, Output, Parameter, Problem, read_model, simulate
from cluster_est.closed_loop.long_records import ways_to_thin
from cluster_est.problem.thinning import MOST_ROWS
from cluster_est.running.resources import Resources
from workers.messages import FloatArray

TIMES = np.arange(12_000) / 1000.0
NOISE = 0.02 * np.random.default_rng(5).standard_normal(len(TIMES))


def simulated(problem: Problem) -> FloatArray:
    """The output where it was measured; the times of a simulation hold those of inputs too."""
    (run,) = problem.experiments
    frame = simulate(problem)[run.id].to_frame()
    place = np.searchsorted(frame["time"], run.outputs[0].times)
    return np.asarray(frame["y"])[place]


def spring() -> Problem:
    """The measured spring is the declared one; it swings fast beside the length of a block."""
    force = np.where(TIMES % 0.9 < 0.45, 40.0, -40.0)
    output = Output("y", TIMES, np.zeros(len(TIMES)), 0.02)
    run = Experiment("long", 0.0, TIMES[-1], (Input("F", TIMES, force),), (output,))
    model = read_model(ROOT / "configs" / "models" / "mass_spring_damper.fmu")
    parameters = (Parameter("m", 0.02, (0.01, 10.0)), Parameter("k", 50.0, (1.0, 500.0)))
    problem = Problem(model, parameters, (run,))
    output = replace(output, values=simulated(problem) + NOISE)
    return replace(problem, experiments=(replace(run, outputs=(output,)),))


def test_a_model_without_fault_leaves_noise_alone_on_corrected_rows():
    found, corrected = next(ways_to_thin(spring(), MOST_ROWS, Resources()))
    ((matrix,),) = found.rows
    (thin,) = found.problem.experiments[0].outputs
    assert corrected is not None
    (output,) = corrected.problem.experiments[0].outputs
    left = output.values - simulated(found.problem)
    np.testing.assert_allclose(left, matrix @ NOISE, atol=1e-5)
    assert np.abs(thin.values - output.values).max() > 1e-3
