"""The noise is found under a misfit of any smooth shape."""

from __future__ import annotations

import numpy as np
import pytest
from support.truth.stacked_noise import stack

from cluster_est.statistics.noise.estimate import estimate_noise


def test_noise_under_a_smooth_trend() -> None:
    generator = np.random.default_rng(1)
    records = stack(2000, 1000, 12, 5, outputs=2)
    sigmas = np.array([0.3, 4.0])
    residuals = np.zeros(records.size)
    for item in records.items:
        t = item.times
        trend = 50.0 * t**3 + 20.0 * np.sin(9.0 * t) * (len(t) > 100) + 7.0
        noise = sigmas[item.output] * generator.standard_normal(len(t))
        residuals[item.rows] = trend + noise
    assert estimate_noise(residuals, records) == pytest.approx(sigmas, rel=0.08)


def test_jumps_are_ignored_and_units_do_not_matter() -> None:
    generator = np.random.default_rng(2)
    records = stack(3000)
    residuals = generator.standard_normal(3000)
    residuals[1000:] += 200.0
    (sigma,) = estimate_noise(residuals, records)
    assert sigma == pytest.approx(1.0, rel=0.08)
    assert estimate_noise(-1e-9 * residuals, records) == pytest.approx(1e-9 * sigma, rel=1e-12)


def test_short_records_count_only_where_there_is_no_other() -> None:
    generator = np.random.default_rng(3)
    long = generator.standard_normal(50)
    short = np.array([5.0, -5.0, 5.0])
    alone = estimate_noise(long, stack(50))
    assert estimate_noise(np.r_[long, short], stack(50, 3)).tolist() == alone.tolist()
    assert estimate_noise(np.r_[short, 3.0 * short], stack(3, 3)) == pytest.approx(np.sqrt(125.0))


def test_coarse_quantisation_gives_the_rms_of_the_differences() -> None:
    # one sample in 40 differs by a step of 1: mean square of the noise 1/40, median 0
    residuals = np.tile(np.r_[1.0, np.zeros(39)], 50)
    (sigma,) = estimate_noise(residuals, stack(2000))
    assert sigma == pytest.approx(np.sqrt(1.0 / 40.0), rel=0.02)
    assert estimate_noise(np.zeros(100), stack(100)).tolist() == [0.0]
