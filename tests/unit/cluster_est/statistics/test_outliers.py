"""Outliers that were planted are found, and what is no outlier is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from cluster_est.statistics.noise.outliers import isolated_outliers
from workers.messages import FloatArray

N = 2000
STEPS = np.arange(N)


def noise(seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(N)


def planted(seed: int, share: float) -> tuple[FloatArray, FloatArray]:
    """Which samples are off, and by how much: 8 to 20."""
    generator = np.random.default_rng([seed, 1])
    off = generator.choice([-1.0, 1.0], N) * generator.uniform(8.0, 20.0, N)
    where = generator.uniform(size=N) < share
    where[:2] = where[-2:] = False
    return where, np.where(where, off, 0.0)


@pytest.mark.parametrize("period", [0, 50, 500])
def test_outliers_are_found_on_any_smooth_course(period: int) -> None:
    course = 100.0 * np.sin(2.0 * np.pi * STEPS / period) if period else np.zeros(N)
    true = found = wrong = 0
    for seed in range(20):
        where, off = planted(seed, 0.01)
        mask = isolated_outliers(course + noise(seed) + off, 1.0).mask
        true += int(where.sum())
        found += int((mask & where).sum())
        wrong += int((mask & ~where).sum())
    assert true > 350
    assert found > 0.85 * true
    assert wrong < 0.02 * true


def test_how_far_the_farthest_is() -> None:
    signal = noise(3)
    signal[700] += 15.0
    signal[1200] -= 30.0
    found = isolated_outliers(2.0 * signal, 2.0)
    assert np.flatnonzero(found.mask).tolist() == [700, 1200]
    assert found.largest == pytest.approx(30.0, abs=4.0)


def test_white_and_coloured_noise_has_none() -> None:
    for seed in range(100):
        assert not isolated_outliers(noise(seed), 1.0).mask.any()
        coloured = lfilter([1.0], [1.0, -0.9], noise(seed))
        assert not isolated_outliers(coloured, 0.5).mask.any()


def peaks(decay: float, height: float = 30.0) -> FloatArray:
    """Events every hundred samples that decay."""
    return lfilter([1.0], [1.0, -decay], np.where(STEPS % 100 == 50, height, 0.0))


@pytest.mark.parametrize(
    "structure",
    [
        np.where(STEPS % 100 < 50, 0.0, 100.0),  # jumps
        np.abs(STEPS % 100 - 50.0) * 20.0,  # kinks: impacts, seen in a position
        np.where(STEPS % 10 < 5, 0.0, 100.0),  # a fast square wave
        100.0 * np.sin(2.0 * np.pi * STEPS / 7.0),
        peaks(0.72),  # a stick-slip, seen in a force
        peaks(0.37),
        np.where(STEPS % 100 < 2, 30.0, 0.0),  # two samples wide
        np.cumsum(np.where(STEPS % 100 < 2, np.where(STEPS % 2, -60.0, 100.0), 0.0)),
    ],
)
def test_a_mechanism_is_no_outlier(structure: FloatArray) -> None:
    masked = [isolated_outliers(structure + noise(seed), 1.0).mask.sum() for seed in range(10)]
    assert sum(masked) <= 1


def test_louder_noise_here_and_there_is_none() -> None:
    louder = 1.0 + 4.0 * np.sin(2.0 * np.pi * STEPS / 500.0) ** 2
    assert sum(isolated_outliers(louder * noise(s), 1.0).mask.sum() for s in range(20)) <= 2


def test_short_and_silent_records() -> None:
    spike = np.r_[np.zeros(5), 100.0, np.zeros(4)]
    assert not isolated_outliers(spike, 1.0).mask.any()
    assert not isolated_outliers(np.zeros(0), 1.0).mask.any()
    longer = np.r_[spike, np.zeros(10)]
    assert np.flatnonzero(isolated_outliers(longer, 1.0).mask).tolist() == [5]
    for unknown in (0.0, np.nan):
        assert not isolated_outliers(longer, unknown).mask.any()


def test_what_is_proven_elsewhere_needs_less() -> None:
    signal = 0.5 * noise(9)
    signal[900] += 5.6
    assert not isolated_outliers(signal, 1.0).mask.any()
    assert np.flatnonzero(isolated_outliers(signal, 1.0, proven=True).mask).tolist() == [900]
