import numpy as np
import pytest

from cluster_est.statistics.fewer_samples import fewer_knots, without_repeats

TIMES = np.arange(5001) * 1e-3
KNOTS = TIMES[::25]


def test_a_held_signal_without_repeats_has_the_same_course():
    values = np.repeat([1.0, 1.0, -2.0, 0.5], 100)
    times, kept = without_repeats(np.arange(400.0), values)
    np.testing.assert_array_equal(times, [0.0, 200.0, 300.0])
    np.testing.assert_array_equal(kept, [1.0, -2.0, 0.5])


def test_a_jump_between_straight_lines_stays_as_it_was():
    values = np.where(TIMES < 2.3333, 1.0, -1.0)
    knots, fitted = fewer_knots(TIMES, values, KNOTS, 1e-3)
    assert len(knots) < 230
    np.testing.assert_allclose(np.interp(TIMES, knots, fitted), values, atol=1e-9)


@pytest.mark.parametrize("shift", [0.1, 0.37, 0.9])
def test_nothing_swings_out_between_the_samples_of_a_jump(shift):
    ramp = np.clip((TIMES - 2.321) / 4e-3, -1.0, 1.0)  # up to a sample before a knot
    knots, fitted = fewer_knots(TIMES, ramp, KNOTS + shift * 1e-3, 1e-3)
    dense = np.linspace(2.3, 2.4, 20_001)
    off = np.interp(dense, knots, fitted) - np.interp(dense, TIMES, ramp)
    assert np.abs(off).max() <= 4e-3


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_a_smooth_signal_is_off_by_less_than_the_tolerance(tolerance):
    values = np.sin(2.0 * np.pi * 2.0 * TIMES)
    knots, fitted = fewer_knots(TIMES, values, KNOTS, tolerance)
    assert len(knots) < 1000
    assert np.abs(np.interp(TIMES, knots, fitted) - values).max() <= 2.0 * tolerance


def test_noise_of_a_signal_needs_no_knots_and_keeps_its_mean():
    values = np.sin(TIMES) + 0.1 * np.random.default_rng(5).standard_normal(len(TIMES))
    knots, fitted = fewer_knots(TIMES, values, KNOTS, 1e-3)
    assert len(knots) < 250
    assert np.interp(TIMES, knots, fitted).mean() == pytest.approx(values.mean(), abs=1e-4)
