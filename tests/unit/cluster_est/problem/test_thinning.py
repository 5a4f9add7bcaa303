from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import ROOT

from cluster_est import Experiment, Input, Output, Parameter, Problem, Solver, read_model
from cluster_est.problem.thinning import MOST_ROWS, WHOLE_INPUTS, ThinningSettings, thinned

RATE, NOISE = 1000.0, 0.01
ROWS = 20_000
TIMES = np.arange(ROWS) / RATE


def spring(rows: int, *, sigma: float = NOISE, colour: float = 0.0) -> Problem:
    """A record of a slow wave in noise."""
    times = TIMES[:rows]
    noise = np.random.default_rng(7).standard_normal(rows)
    for n in range(1, rows if colour else 0):
        noise[n] = colour * noise[n - 1] + np.sqrt(1.0 - colour**2) * noise[n]
    force = np.where(times % 4.0 < 2.0, 1.0, -1.0)
    run = Experiment(
        "long",
        0.0,
        float(times[-1]),
        (Input("F", times, force, "hold"),),
        (Output("y", times, np.sin(3.0 * times) + NOISE * noise, sigma),),
    )
    model = read_model(ROOT / "configs" / "models" / "mass_spring_damper.fmu")
    return Problem(model, (Parameter("m", 1.2, (0.1, 10.0)),), (run,))


@pytest.mark.parametrize("most", [None, MOST_ROWS])
def test_short_records_stay_as_they_are(most):
    problem = spring(3000)
    found = thinned(problem, most)
    assert found.problem is problem or found.problem == problem
    assert found.problem.experiments[0] is problem.experiments[0]
    assert not found.is_thinner


def test_a_long_record_has_fewer_rows_with_the_noise_that_is_left():
    found = thinned(spring(ROWS), MOST_ROWS)
    (output,) = found.problem.experiments[0].outputs
    assert 400 <= len(output.times) <= MOST_ROWS
    off = (output.values - np.sin(3.0 * output.times)) / output.sigmas
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.1)
    assert "20,000" in found.sentence


def test_rows_come_from_the_measured_ones_by_the_matrix_that_is_handed_out():
    problem = spring(ROWS)
    found = thinned(problem, MOST_ROWS)
    (matrix,) = found.rows[0]
    (output,) = found.problem.experiments[0].outputs
    np.testing.assert_allclose(matrix @ problem.experiments[0].outputs[0].values, output.values)


def test_held_inputs_keep_their_jumps():
    (given,) = thinned(spring(ROWS), MOST_ROWS).problem.experiments[0].inputs
    assert given.interpolation == "hold"
    np.testing.assert_allclose(given.times, [0.0, *np.arange(2.0, 20.0, 2.0)])


@pytest.mark.parametrize("colour", [0.5, 0.8, 0.95, 0.99])
def test_rows_of_coloured_noise_are_even_and_as_noisy_as_their_sigma_says(colour):
    (output,) = thinned(spring(ROWS, colour=colour), MOST_ROWS).problem.experiments[0].outputs
    assert 300 <= len(output.times) <= MOST_ROWS
    steps = np.diff(output.times)
    assert np.quantile(steps, 0.9) == pytest.approx(np.quantile(steps, 0.3), rel=0.05)
    off = (output.values - np.sin(3.0 * output.times)) / output.sigmas
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.2)


def test_an_output_has_the_noise_of_most_of_its_records_in_all():
    """In a record of one output the noise is white: a correlation is that of the sensor."""
    runs = []
    for n, colour in enumerate([0.9, 0.9, 0.0]):
        (run,) = spring(6000, colour=colour).experiments
        runs.append(replace(run, id=f"long {n}"))
    found = thinned(replace(spring(6000), experiments=tuple(runs)), MOST_ROWS)
    for run in found.problem.experiments:
        steps = np.diff(run.outputs[0].times)
        assert np.quantile(steps, 0.9) == pytest.approx(np.quantile(steps, 0.3), rel=0.2)


def test_a_signal_that_is_too_fast_for_blocks_is_not_thinned():
    problem = spring(ROWS)
    (run,) = problem.experiments
    fast = np.sin(2.0 * np.pi * 200.0 * TIMES)
    outputs = (replace(run.outputs[0], values=fast),)
    problem = replace(problem, experiments=(replace(run, outputs=outputs),))
    assert not thinned(problem, MOST_ROWS).is_thinner


def test_a_record_that_takes_more_rows_keeps_its_end():
    problem = spring(ROWS)
    (run,) = problem.experiments
    (output,) = run.outputs
    values = output.values + np.sin(2.0 * np.pi * 15.0 * TIMES)
    problem = replace(
        problem, experiments=(replace(run, outputs=(replace(output, values=values),)),)
    )
    (found,) = thinned(problem, MOST_ROWS).problem.experiments
    (output,) = found.outputs
    assert found.stop == run.stop
    assert MOST_ROWS < len(output.times) < ROWS / 2
    assert np.diff(output.times, prepend=run.start, append=run.stop).max() < 0.02


def test_in_co_simulation_rows_are_at_times_of_samples():
    problem = spring(ROWS)
    model = replace(problem.model, interface="co_simulation", solver=Solver("fmu"))
    problem = replace(problem, model=model)
    (found,) = thinned(problem, MOST_ROWS).problem.experiments
    assert set(found.outputs[0].times) <= set(TIMES)
    assert len(found.inputs[0].times) == 10
    (found,) = thinned(problem, MOST_ROWS, WHOLE_INPUTS).problem.experiments
    assert len(found.inputs[0].times) == ROWS


def test_inputs_are_whole_where_that_is_asked_for():
    problem = spring(ROWS)
    (run,) = problem.experiments
    wave = Input("F", TIMES, np.sin(TIMES))
    problem = replace(problem, experiments=(replace(run, inputs=(wave,)),))
    fewer, whole = (
        thinned(problem, MOST_ROWS, *how).problem.experiments[0].inputs[0]
        for how in ((), (WHOLE_INPUTS,))
    )
    assert len(fewer.times) < 2 * MOST_ROWS
    assert whole is wave


@pytest.mark.parametrize(
    ("rows", "loop", "fit"), [("auto", MOST_ROWS, None), ("no", None, None), (500, 500, 500)]
)
def test_a_fit_is_thinned_only_where_a_number_is_given(rows, loop, fit):
    settings = ThinningSettings(rows=rows)
    assert (settings.most(), settings.most(auto=False)) == (loop, fit)
