import numpy as np
import pytest

from cluster_est.statistics.block_fits import BlockFits, block_values, even_blocks

COUNT, LENGTH = 4000, 20
TIMES = np.arange(COUNT) * 1e-3
BLOCKS = even_blocks(np.array([[0, COUNT]]), LENGTH)


def test_a_cubic_has_its_own_values_in_the_middle_of_blocks():
    cubic = 1.0 + TIMES - 3.0 * TIMES**2 + 0.5 * TIMES**3
    middle, weights = block_values(BLOCKS, TIMES)
    expected = 1.0 + middle - 3.0 * middle**2 + 0.5 * middle**3
    np.testing.assert_allclose(weights @ cubic, expected, rtol=1e-12)


def test_uneven_times_change_nothing_about_that():
    times = np.sort(np.random.default_rng(2).uniform(0.0, 4.0, COUNT))
    middle, weights = block_values(BLOCKS, times)
    np.testing.assert_allclose(weights @ times**2, middle**2, atol=1e-12)


def test_the_noise_of_a_value_is_that_of_its_weights():
    noise = np.random.default_rng(1).standard_normal(COUNT)
    _, weights = block_values(BLOCKS, TIMES)
    size = np.sqrt(np.asarray(weights.power(2).sum(axis=1)).ravel())
    np.testing.assert_allclose(size, 1.5 / np.sqrt(LENGTH), rtol=0.01)
    assert np.std(weights @ noise) == pytest.approx(float(size[0]), rel=0.15)


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
