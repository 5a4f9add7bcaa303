"""Noise that grows with the signal is told from noise that does not, and from misfit."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.statistics.noise.growing_noise import noise_growth

N = 2500
SIZE = 100.0 * np.abs(np.sin(2.0 * np.pi * np.arange(N) / 300.0))


def test_noise_that_grows() -> None:
    generator = np.random.default_rng(1)
    # a third of |sin| is below 0.5, a third above 0.87
    grown = noise_growth(np.where(SIZE > 60.0, 3.0, 1.0) * generator.standard_normal(N), SIZE)
    assert grown.p < 1e-6
    assert grown.quiet == pytest.approx(1.0, rel=0.25)
    assert grown.loud == pytest.approx(3.0, rel=0.25)


def test_its_two_parts_even_where_the_signal_swings_through_zero() -> None:
    generator = np.random.default_rng(4)
    swing = 100.0 * np.sin(2.0 * np.pi * np.arange(N) / 40.0)
    for constant, part in ((2.0, 0.05), (5.0, 0.2)):
        noise = np.hypot(constant, part * swing) * generator.standard_normal(N)
        grown = noise_growth(noise, swing + noise)
        assert grown.constant == pytest.approx(constant, rel=0.2)
        assert grown.part == pytest.approx(part, rel=0.1)
    alone = noise_growth(0.05 * SIZE * generator.standard_normal(N), SIZE)
    assert alone.part == pytest.approx(0.05, rel=0.1)
    assert 0.0 < alone.constant < 0.3


def test_p_values_are_even_where_it_does_not_even_under_a_misfit_that_grows() -> None:
    generator = np.random.default_rng(2)
    misfit = 1e-2 * SIZE**2
    found = [noise_growth(generator.standard_normal(N) + misfit, SIZE).p for _ in range(300)]
    assert min(found) > 1e-4
    assert np.mean(np.array(found) < 0.1) == pytest.approx(0.1, abs=0.06)
    assert np.median(found) == pytest.approx(0.5, abs=0.12)


def test_nothing_to_compare() -> None:
    generator = np.random.default_rng(3)
    for n in (0, 6, 40):
        assert noise_growth(generator.standard_normal(n), np.arange(float(n))).p == 1.0
    assert noise_growth(generator.standard_normal(500), np.ones(500)).p == 1.0
    assert noise_growth(np.zeros(500), np.arange(500.0)).p == 1.0
