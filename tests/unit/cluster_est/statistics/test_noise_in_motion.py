"""Noise where a signal rests, moves, and is quantised: truth from how the data were made."""

from __future__ import annotations

import numpy as np
import pytest
from support.truth.stacked_noise import stack

from cluster_est.statistics.noise.estimate import estimate_noise
from cluster_est.statistics.noise.quantisation import quantisation_step
from workers.messages import FloatArray

N = 2500


def wave(n: int, period: float = 200.0) -> FloatArray:
    return 100.0 * np.sin(2.0 * np.pi * np.arange(n) / period)


def move_in_the_middle(at_rest: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Noise of 1 in the fifth of a record that moves, and little of it elsewhere."""
    generator = np.random.default_rng(seed)
    signal = np.zeros(N)
    signal[1000:1500] = wave(500)
    size = np.full(N, at_rest)
    size[1000:1500] = 1.0
    noise = size * generator.standard_normal(N)
    return noise, signal + noise


@pytest.mark.parametrize("n", [500, 2000])
def test_white_noise_of_a_signal_that_moves_is_unbiased(n: int) -> None:
    generator = np.random.default_rng(n)
    found = []
    for _ in range(300):
        noise = generator.standard_normal(n)
        found.append(estimate_noise(noise, stack(n), wave(n) + noise)[0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.03)


def test_knowing_the_signal_changes_nothing_where_the_noise_is_the_same() -> None:
    generator = np.random.default_rng(4)
    for _ in range(100):
        noise = generator.standard_normal(N)
        rested = np.where(np.arange(N) < 500, wave(N), 0.0) + noise
        alone = estimate_noise(noise, stack(N)).tolist()
        assert estimate_noise(noise, stack(N), rested).tolist() == alone


@pytest.mark.parametrize("at_rest", [0.0, 1e-5, 0.3])
def test_noise_is_that_of_the_motion(at_rest: float) -> None:
    found = []
    for seed in range(40):
        noise, measured = move_in_the_middle(at_rest, seed)
        found.append(estimate_noise(noise, stack(N), measured)[0])
        assert estimate_noise(noise, stack(N))[0] < 0.6  # which does not know the motion
    assert np.mean(found) == pytest.approx(1.0, abs=0.12)


def test_structure_in_motion_is_no_noise() -> None:
    # 20 samples a period: the fourth difference keeps 1.6 of 100, the eighth next to nothing
    found = []
    for seed in range(20):
        noise, measured = move_in_the_middle(1.0, seed)
        structure = np.where(np.abs(measured) > 5.0, wave(N, 20.0), 0.0)
        found.append(estimate_noise(noise + structure, stack(N), measured + structure)[0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("step", [1.0, 2.0])
@pytest.mark.parametrize("moving", [True, False])
def test_a_quantised_signal(step: float, moving: bool) -> None:
    generator = np.random.default_rng(5)
    found = []
    for _ in range(40):
        true = wave(N) if moving else np.full(N, generator.uniform(0.0, step))
        measured = step * np.round((true + generator.standard_normal(N)) / step)
        found.append(estimate_noise(measured - true, stack(N), measured)[0])
    assert np.mean(found) == pytest.approx(np.sqrt(1.0 + step**2 / 12.0), rel=0.04)


def test_an_encoder_at_rest_has_the_noise_of_its_step() -> None:
    true = np.where(np.abs(np.arange(N) - 1250) < 250, wave(N), 0.0) + 1e-4 * wave(N, 900.0)
    measured = 0.5 * np.round(true / 0.5)
    assert estimate_noise(measured - true, stack(N))[0] < 1e-3
    found = estimate_noise(measured - true, stack(N), measured)
    assert found[0] > 0.999 * 0.5 / np.sqrt(12.0)


def test_the_step_of_a_signal() -> None:
    generator = np.random.default_rng(6)
    counts = generator.integers(-40, 40, 300)
    assert quantisation_step(0.1 * counts + 7.03) == pytest.approx(0.1, rel=1e-9)
    assert quantisation_step(np.round(generator.standard_normal(50), 1)) == pytest.approx(0.1)
    assert quantisation_step(np.where(counts > 0, 2.0, 1.5)) == 0.5
    for silent in (np.zeros(0), np.ones(30), generator.standard_normal(3)):
        assert quantisation_step(silent) == 0.0
    for _ in range(200):
        assert quantisation_step(generator.standard_normal(40)) == 0.0
    # clipped, or at rest: values repeat, but they have no step in common
    assert quantisation_step(np.maximum(generator.standard_normal(300), 0.5)) == 0.0
    assert quantisation_step(np.where(np.arange(300) < 250, 0.0, wave(300) / 3.0)) == 0.0
