"""Signals that keep their value and jump."""

import numpy as np
import pytest

import cluster_est as ce
from cluster_est.problem.tables.jumps import count_jumps, jump_notes, jump_times

TIMES = 0.01 * np.arange(400)
LEVELS = np.random.default_rng(3).uniform(-1.0, 1.0, 8)
STEPS = LEVELS[np.arange(400) // 50]


def test_the_jumps_of_steps_are_counted():
    assert count_jumps(TIMES, STEPS) == 7


@pytest.mark.parametrize("scale", [1e-9, -1e9])
@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_scale_and_offset_do_not_matter(scale, shift):
    assert count_jumps(1e3 * TIMES, scale * (STEPS + shift)) == 7


def test_a_binary_sequence_jumps_though_at_neighbouring_samples():
    """Its clock is that of the record, so that half of the changes touch others."""
    sequence = np.sign(np.random.default_rng(7).standard_normal(400))
    held = np.repeat(sequence[:200], 2)
    assert count_jumps(TIMES, held) == np.sum(np.diff(held) != 0.0)


@pytest.mark.parametrize(
    "values",
    [
        np.sin(TIMES),
        np.ones(400),
        np.round(np.sin(TIMES) / 0.02) * 0.02,  # the steps of a converter
        np.clip(TIMES, 1.0, 2.0),  # a ramp between two values that it keeps
        np.where(np.arange(400) == 9, np.nan, STEPS),
        np.random.default_rng(4).standard_normal(400),
    ],
    ids=["smooth", "constant", "converter", "ramp", "with a gap", "noise"],
)
def test_others_do_not(values):
    assert count_jumps(TIMES, values) == 0


@pytest.mark.parametrize("step", [0.5, 0.3])
def test_a_slow_signal_that_was_rounded_does_not_jump(step):
    """A room's temperature over a day, as a display shows it."""
    hours = np.linspace(0.0, 24.0, 300)
    temperature = 21.0 + 1.2 * np.sin(2.0 * np.pi * hours / 24.0)
    assert count_jumps(hours, np.round(temperature / step) * step) == 0


def test_a_staircase_jumps():
    stairs = np.repeat([0.0, 1.0, 2.0, 3.0, 2.0, 1.0], 50)
    assert count_jumps(TIMES[:300], stairs) == 5


def test_a_ramp_with_points_of_its_own_is_none():
    """Straight lines are meant: the two points of a ramp are closer than the others."""
    times = np.sort(np.concatenate([np.arange(12.0), [2.99, 6.99]]))
    values = np.where(times < 3.0, 1.0, np.where(times < 7.0, 4.0, 2.0))
    assert count_jumps(times, values) == 0


def test_what_is_held_already_needs_no_note():
    outputs = (ce.Output("y", TIMES, TIMES, 1.0),)

    def notes(how):
        given = (ce.Input("u", TIMES, STEPS, how),)
        runs = [ce.Experiment(f"run {i}", 0.0, 4.0, given, outputs) for i in range(2)]
        return jump_notes(runs)

    assert notes("hold") == ()
    (note,) = notes("linear")
    assert note.startswith("input u keeps its value and jumps 14 times; straight lines")
    assert 'inputs.u = { column = "COLUMN", interpolation = "hold" }' in note


@pytest.mark.parametrize(("interpolation", "early"), [("linear", 0.01), ("hold", 0.0)])
def test_a_jump_begins_where_the_signal_begins_to_change(interpolation, early):
    """Between two samples it is a ramp, unless it is held."""
    at = jump_times(ce.Input("u", TIMES, STEPS, interpolation))
    np.testing.assert_allclose(at, 0.5 * np.arange(1, 8) - early)


def test_what_keeps_no_value_has_no_jumps():
    assert not len(jump_times(ce.Input("u", TIMES, np.sin(TIMES))))
