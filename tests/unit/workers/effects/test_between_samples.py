import numpy as np
import pytest

from workers.effects.outputs import PIECES, refine
from workers.effects.signal_memory import SampledSignal, backlash, delay
from workers.grid import build_grid
from workers.messages import Experiment, Input, Output


def grid(times, held=None):
    """A grid with one input, held between the times, or none."""
    inputs = () if held is None else (Input("u", times, held, "hold"),)
    recorded = (Output("y", times, 0.0 * times),)
    return build_grid(Experiment("e", times[0], times[-1], inputs, recorded))


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_cubic_is_met_exactly_on_any_times(spread):
    times = np.arange(12.0) + spread * np.random.default_rng(1).random(12)
    outputs = np.column_stack([times**3 - 4.0 * times**2, 1.0 - times])
    fine, seen = refine(grid(times), outputs)
    assert len(fine.times) == 11 * PIECES + 1
    np.testing.assert_allclose(seen[:, 0], fine.times**3 - 4.0 * fine.times**2, atol=1e-9)
    np.testing.assert_allclose(seen[:, 1], 1.0 - fine.times, atol=1e-12)


def test_what_was_recorded_stays_as_it_was():
    random = np.random.default_rng(2)
    times, outputs = np.sort(random.random(30)), random.normal(size=(30, 3))
    fine, seen = refine(grid(times), outputs)
    assert np.array_equal(seen[::PIECES], outputs)
    assert np.array_equal(fine.times[::PIECES], times)


def test_a_wave_with_ten_records_to_a_period():
    times = np.arange(0.0, 5.01, 0.1)
    fine, seen = refine(grid(times), np.sin(2.0 * np.pi * times)[:, None])
    wrong = np.abs(seen[:, 0] - np.sin(2.0 * np.pi * fine.times))
    assert wrong[PIECES:-PIECES].max() < 0.004
    assert wrong.max() < 0.02  # at the ends all records lie on one side


def test_no_cubic_reaches_across_a_jump_of_an_input():
    """The output is a straight line on both sides of its kink."""
    times = np.arange(11.0)
    held = np.where(times < 5.0, 0.0, 1.0)
    fine, seen = refine(grid(times, held), np.maximum(times - 5.0, 0.0)[:, None])
    np.testing.assert_allclose(seen[:, 0], np.maximum(fine.times - 5.0, 0.0), atol=1e-12)
    assert np.array_equal(fine.inputs[:, 0], np.where(fine.times < 5.0, 0.0, 1.0))


def test_a_gap_is_crossed_by_a_straight_line():
    times = np.array([0.0, 0.1, 0.2, 0.3, 9.0, 9.1, 9.2, 9.3])
    fine, seen = refine(grid(times), np.sin(times)[:, None])
    gap = (fine.times > 0.3) & (fine.times < 9.0)
    line = np.interp(fine.times, times, np.sin(times))
    np.testing.assert_allclose(seen[gap, 0], line[gap])


@pytest.mark.parametrize("count", [2, 3])
def test_few_records_are_joined_by_straight_lines(count):
    times = np.arange(float(count))
    fine, seen = refine(grid(times), (times**2)[:, None])
    np.testing.assert_allclose(seen[:, 0], np.interp(fine.times, times, times**2))


def test_samples_that_a_delay_moves_to_one_time_are_one():
    """A backlash may be crossed one rounding unit before a sample."""
    times = np.array([0.0, 1.0 - 2.0**-53, 1.0, 2.0])
    moved = delay(SampledSignal(times, np.array([0.0, 1.0, 2.0, 3.0])), 10.0)
    assert moved.times.tolist() == [10.0, 11.0, 12.0]
    assert moved.values.tolist() == [0.0, 2.0, 3.0]


def test_a_backlash_and_a_delay_give_increasing_times():
    generator = np.random.default_rng(5)
    for _ in range(200):
        times = np.cumsum(generator.uniform(0.01, 0.02, 100))
        # steps as large as the play are crossed at the samples, but for rounding
        values = 0.1 * np.cumsum(generator.integers(-2, 3, 100))
        moved = delay(backlash(SampledSignal(times, values), 0.1), generator.uniform(0.0, 1.0))
        assert (np.diff(moved.times) > 0.0).all()


def test_a_delay_of_plain_samples_keeps_their_values():
    signal = SampledSignal(np.array([0.0, 1.0]), np.array([3.0, 4.0]))
    moved = delay(signal, 0.5)
    assert moved.times.tolist() == [0.5, 1.5]
    assert moved.values.tolist() == [3.0, 4.0]
