"""Signals that are changed as a whole."""

import numpy as np

from workers.effects.memory import SampledSignal, backlash, delay


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
    assert moved.values is signal.values
