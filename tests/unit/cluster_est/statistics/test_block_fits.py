import numpy as np
import pytest
from scipy.signal import lfilter

from cluster_est.statistics.block_fits import NODES, BlockFits, block_values, even_blocks

COUNT, LENGTH = 4000, 20
TIMES = np.arange(COUNT) * 1e-3
BLOCKS = even_blocks(np.array([[0, COUNT]]), LENGTH)


UNEVEN = np.sort(np.random.default_rng(2).uniform(0.0, 4.0, COUNT))


@pytest.mark.parametrize("times", [TIMES, UNEVEN], ids=["even", "uneven"])
def test_a_cubic_has_its_own_values_at_the_nodes_of_blocks(times):
    nodes, weights = block_values(BLOCKS, times)
    assert np.all(np.diff(nodes) > 0.0)
    cubic = 1.0 + times - 3.0 * times**2 + 0.5 * times**3
    expected = 1.0 + nodes - 3.0 * nodes**2 + 0.5 * nodes**3
    np.testing.assert_allclose(weights @ cubic, expected, rtol=1e-9)


@pytest.mark.parametrize("times", [TIMES, UNEVEN], ids=["even", "uneven"])
def test_white_noise_stays_white_and_values_stand_for_all_samples(times):
    _, weights = block_values(BLOCKS, times)
    covariance = (weights @ weights.T).toarray()
    variances = np.diag(covariance)
    np.testing.assert_allclose(covariance, np.diag(variances), atol=1e-12)
    np.testing.assert_allclose((1.0 / variances).reshape(-1, NODES).sum(axis=1), LENGTH)


def test_a_sum_of_squares_of_what_is_slow_stays_as_it_is():
    slow = np.sin(3.0 * TIMES)
    _, weights = block_values(BLOCKS, TIMES)
    variances = np.asarray(weights.power(2).sum(axis=1)).ravel()
    assert np.sum((weights @ slow) ** 2 / variances) == pytest.approx(np.sum(slow**2), rel=1e-9)


def test_nodes_at_samples_are_samples():
    nodes, weights = block_values(BLOCKS, TIMES, at_samples=True)
    assert set(nodes) <= set(TIMES)
    np.testing.assert_allclose(weights @ TIMES**2, nodes**2, atol=1e-12)


def test_blocks_in_which_a_signal_jumps_are_poor_and_those_of_noise_are_not():
    signal = 0.01 * np.random.default_rng(3).standard_normal(COUNT)
    assert not BlockFits.of(BLOCKS, TIMES, signal).poor(1e-4).any()
    signal[1010:] += 1.0
    fits = BlockFits.of(BLOCKS, TIMES, signal)
    (poor,) = np.flatnonzero(fits.poor(fits.noise))
    assert BLOCKS[poor, 0] <= 1010 < BLOCKS[poor, 1]


def test_what_is_bent_in_a_block_shows_beside_half_as_long_ones():
    waves = np.sin(2.0 * np.pi * 30.0 * TIMES) + 1e-3 * np.random.default_rng(4).standard_normal(
        COUNT
    )
    half = even_blocks(np.array([[0, COUNT]]), LENGTH // 2)
    ratio = BlockFits.of(BLOCKS, TIMES, waves).bent / BlockFits.of(half, TIMES, waves).bent
    assert ratio > 30.0


@pytest.mark.parametrize("length", [8, 20, 3000])
def test_even_blocks_leave_nothing_out(length):
    stretches = np.array([[0, 5], [5, 1000], [1000, COUNT]])
    blocks = even_blocks(stretches, length)
    assert blocks[0, 0] == 0
    assert blocks[-1, 1] == COUNT
    np.testing.assert_array_equal(blocks[1:, 0], blocks[:-1, 1])
    assert set(stretches[:, 0]) <= set(blocks[:, 0])


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_the_memory_of_noise_is_told_from_how_it_bends_in_blocks(correlation):
    noise = np.random.default_rng(4).standard_normal(200_000)
    noise = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], noise)
    blocks = even_blocks(np.array([[0, len(noise)]]), 100)
    fits = BlockFits.of(blocks, np.arange(float(len(noise))), noise)
    found = fits.noise_memory
    assert found.correlation == pytest.approx(correlation, abs=0.1)
    assert fits.noise / found.within == pytest.approx(1.0, abs=0.15)
