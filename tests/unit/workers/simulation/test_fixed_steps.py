"""When a co-simulation FMU communicates that cannot vary its step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import FMU

from workers.errors import ModelError
from workers.fmu.description import describe
from workers.messages import Experiment, Input, Model, Output, Solver
from workers.simulation.bind_experiment import bind_experiment
from workers.simulation.fixed_step import communication_notes, step_lengths

DESCRIPTION = replace(
    describe(FMU.name, FMU.read_bytes()), variable_steps=False, fixed_internal_step=None
)
SILENT = replace(DESCRIPTION, default_step=None)


def model(step=None, **more):
    solver = Solver("fmu", step=step, **more)
    return Model(FMU.name, FMU.read_bytes(), "co_simulation", solver, ("k",))


def experiment(times, inputs=()):
    times = np.array(times, np.float64)
    return Experiment("e", times[0], times[-1], inputs, (Output("y", times, 0.0 * times),))


def communication(times, step=None, description=SILENT, inputs=()):
    ready = bind_experiment(model(step), description, experiment(times, inputs))
    np.testing.assert_array_equal(ready.grid.times, np.array(times, np.float64))
    return ready.communication


@pytest.mark.parametrize(
    ("times", "step", "expected"),
    [
        ([0.0, 0.1, 0.2], None, 0.1),
        ([0.0, 0.1, 0.3, 0.4], None, 0.1),
        ([0.0, 0.15, 0.25], 0.05, 0.05),
        ([5.0, 5.3, 1e4 + 5.0], 0.1, 0.1),
    ],
)
def test_multiples_of_the_step_need_no_interpolation(times, step, expected):
    made = communication(times, step)
    assert made.step == pytest.approx(expected, rel=1e-12)
    assert not made.fractions.any()
    np.testing.assert_array_equal(made.before, np.arange(len(times)))
    np.testing.assert_allclose(made.grid.times, times, rtol=1e-15)
    records = np.random.default_rng(1).normal(size=(2, len(times), 1))
    assert made.interpolate(records).tobytes() == records.tobytes()
    assert communication_notes(model(step), SILENT, [experiment(times)]) == ()


def test_the_points_around_a_time_are_taken_and_one_beyond_the_last():
    made = communication([2.0, 2.25, 2.3, 2.71], 0.1)
    np.testing.assert_allclose(made.grid.times, [2.0, 2.2, 2.3, 2.7, 2.8], rtol=1e-15)
    np.testing.assert_array_equal(made.before, [0, 1, 2, 3])
    np.testing.assert_array_equal(made.after, [0, 2, 2, 4])
    np.testing.assert_allclose(made.fractions, [0.0, 0.5, 0.0, 0.1], atol=1e-9)
    line = 3.0 * made.grid.times[None, :, None] - 1.0
    np.testing.assert_allclose(
        made.interpolate(line)[0, :, 0], 3.0 * np.array([2.0, 2.25, 2.3, 2.71]) - 1.0, rtol=1e-14
    )


def test_what_moves_at_events_alone_keeps_its_value():
    discrete = replace(SILENT.variables["y"], variability="discrete")
    held = replace(SILENT, variables={**SILENT.variables, "y": discrete})
    made = communication([0.0, 0.15], 0.1, held)
    np.testing.assert_array_equal(
        made.interpolate(np.array([[[1.0], [2.0], [7.0]]]))[0, :, 0], [1, 2]
    )


def test_the_step_is_the_configured_one_or_else_the_fmus_own():
    times = [0.0, 0.3, 0.6]
    named = replace(SILENT, default_step=0.2)
    fixed = replace(named, fixed_internal_step=0.05)
    assert communication(times, 0.1, fixed).step == 0.1
    assert communication(times, None, fixed).step == 0.05
    assert communication(times, None, named).step == 0.2
    assert communication(times, None, replace(named, default_step=0.0)).step == 0.3


def test_a_held_input_has_jumped_at_a_point_that_rounding_puts_before_it():
    knot = 0.7000000000000001  # 7 * 0.1 > 0.7, and 0.7 is before it
    times = np.array([0.0, knot])
    inputs = (Input("F", times, np.array([1.0, 2.0]), "hold"),)
    made = communication([0.0, 0.1, knot, 0.8], 0.1, inputs=inputs)
    np.testing.assert_array_equal(made.grid.inputs[:, 0], [1.0, 1.0, 2.0, 2.0])
    nearly = (Input("F", np.array([0.0, 0.3 + 1e-9]), np.array([1.0, 2.0]), "hold"),)
    made = communication([0.0, 0.1, 0.3 + 1e-9, 0.4], 0.1, inputs=nearly)
    np.testing.assert_array_equal(made.grid.inputs[:, 0], [1.0, 1.0, 2.0, 2.0])


def test_inputs_between_the_points_are_linear_from_point_to_point():
    knots = np.array([0.0, 0.15, 0.4])
    inputs = (Input("F", knots, np.array([0.0, 3.0, 3.0])),)
    made = communication([0.0, 0.15, 0.4], 0.1, inputs=inputs)
    np.testing.assert_allclose(made.grid.times, [0.0, 0.1, 0.2, 0.4])
    np.testing.assert_allclose(made.grid.inputs[:, 0], [0.0, 2.0, 3.0, 3.0])
    np.testing.assert_allclose(made.grid.slopes[:, 0], [20.0, 10.0, 0.0, 0.0], atol=1e-12)


def test_times_without_a_common_step_are_refused_with_advice():
    with pytest.raises(ModelError, match=r"experiment 'e'.*fixed length.*set model\.step"):
        communication([0.0, 0.1, 0.25])


def test_too_many_steps_are_refused_with_advice():
    with pytest.raises(ModelError, match=r"experiment 'e'.*more than model\.max_steps = 1000000"):
        communication([0.0, 1.0], 1e-9)


def test_a_user_is_told_which_experiments_are_interpolated():
    runs = [experiment([0.0, 0.25]), experiment([0.0, 0.2])]
    (said,) = communication_notes(model(0.1), SILENT, runs)
    assert "every 0.1 s; experiment 'e' has times between them" in said
    (said,) = communication_notes(model(0.1), SILENT, [runs[0], replace(runs[0], id="f")])
    assert "2 experiments have times between them" in said


@pytest.mark.parametrize("start", [0.0, 100.0, 1e4])
@pytest.mark.parametrize("step", [0.05, 0.001, 1.0 / 3.0, 0.02])
@pytest.mark.parametrize("own_step", [None, 0.01])
def test_equal_steps_have_equal_lengths(start: float, step: float, own_step: float | None) -> None:
    times = start + step * np.arange(1000)
    lengths = step_lengths(times, own_step)
    np.testing.assert_allclose(lengths[:-1], np.diff(times), rtol=0, atol=1e-15 * times[-1])
    assert step != 0.05 or len(np.unique(np.diff(times))) > 1
    if own_step and step in (0.05, 0.02):
        assert set(lengths[:-1]) == {step}
    else:
        assert np.all(
            (lengths[:-1] == step) | (times[:-1] + step < times[1:]) | (step == 1.0 / 3.0)
        )
        assert np.all(times[:-1] + lengths[:-1] >= times[1:])
    assert lengths[-1] == 0.0


def test_times_that_are_uneven_stay_so() -> None:
    times = np.cumsum(np.random.default_rng(3).uniform(0.01, 0.02, 50))
    np.testing.assert_allclose(step_lengths(times, None)[:-1], np.diff(times), rtol=0, atol=1e-15)


def test_a_multiple_of_the_own_step_is_taken() -> None:
    assert step_lengths(np.array([0.3, 0.4]), 0.1).tolist() == [0.1, 0.0]
    own = 1.0 / 128.0 + 2.0**-60
    times = np.array([3.0, 3.0 + 5 * own])
    assert step_lengths(times, own)[0] == 5 * own
