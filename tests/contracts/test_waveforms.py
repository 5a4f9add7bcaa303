"""What every waveform of a design must do. A new one is picked up by its line."""

import numpy as np
import pytest

from cluster_est.experiment_design.limits import InputLimits
from cluster_est.experiment_design.waveforms import LEVEL_COORDINATES, WAVEFORMS

EVERY = pytest.mark.parametrize("name", WAVEFORMS)
TIMES = 0.05 * np.arange(401)
LIMITS = InputLimits(-3.0, 5.0)


def points(name, count=60, seed=3):
    return np.random.default_rng(seed).random((count, LEVEL_COORDINATES + WAVEFORMS[name].size))


def signals(name, limits=LIMITS, times=TIMES, **how):
    return [WAVEFORMS[name].signal(point, times, limits) for point in points(name, **how)]


@EVERY
def test_it_is_known_by_its_own_name(name):
    assert WAVEFORMS[name].name == name


@EVERY
@pytest.mark.parametrize("count", [11, 401, 3000])
def test_every_point_gives_a_signal_within_the_limits(name, count):
    times = 0.1 * np.arange(count)
    for signal in signals(name, times=times):
        assert signal.shape == (count,)
        assert np.isfinite(signal).all()
        assert signal.min() >= LIMITS.lower
        assert signal.max() <= LIMITS.upper


@EVERY
def test_the_corners_of_the_cube_are_signals_too(name):
    for corner in (0.0, 1.0):
        point = np.full(LEVEL_COORDINATES + WAVEFORMS[name].size, corner)
        signal = WAVEFORMS[name].signal(point, TIMES, LIMITS)
        assert LIMITS.lower <= signal.min() <= signal.max() <= LIMITS.upper


@EVERY
def test_a_point_gives_the_same_signal_again(name):
    for one, other in zip(signals(name), signals(name), strict=True):
        np.testing.assert_array_equal(one, other)


@EVERY
def test_its_rate_is_kept_and_it_begins_where_it_must(name):
    limits = InputLimits(-3.0, 5.0, rate=2.0, start=1.0)
    for signal in signals(name, limits):
        assert signal[0] == 1.0
        assert np.abs(np.diff(signal)).max() <= 2.0 * 0.05 * (1.0 + 1e-9)


@EVERY
def test_points_differ_in_what_they_feed_in(name):
    found = {signal.tobytes() for signal in signals(name)}
    assert len(found) == 60


@EVERY
def test_a_full_amplitude_uses_most_of_the_range(name):
    cube = points(name)
    cube[:, 0] = 1.0
    spans = [np.ptp(WAVEFORMS[name].signal(point, TIMES, LIMITS)) for point in cube]
    assert max(spans) > 0.8 * (LIMITS.upper - LIMITS.lower)


@EVERY
def test_a_small_amplitude_may_lie_anywhere(name):
    cube = points(name)
    cube[:, 0] = 0.0
    means = [WAVEFORMS[name].signal(point, TIMES, LIMITS).mean() for point in cube]
    assert min(means) < -1.0
    assert max(means) > 3.0


@pytest.mark.parametrize("name", ["steps", "prbs"])
def test_levels_are_held_for_as_long_as_they_must_be(name):
    limits = InputLimits(-3.0, 5.0, hold=1.5)
    for signal in signals(name, limits):
        changes = TIMES[1:][np.abs(np.diff(signal)) > 1e-12]
        assert not len(changes) or np.diff(changes).min(initial=np.inf) >= 1.5 - 0.051
