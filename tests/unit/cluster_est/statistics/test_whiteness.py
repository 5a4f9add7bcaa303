"""The test of whiteness: its null distribution, and the structure that it sees."""

import numpy as np
import pytest
from support.truth.stacked_noise import stack

from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.whiteness import (
    SmoothedColumns,
    StructureKernel,
    WhiteNull,
    smoothness,
    traces,
)

RECORDS = stack(150, 100, outputs=2)
KERNELS = [StructureKernel(1.0), StructureKernel(6.0), StructureKernel(5.0, 0.7)]


def null(noise: float = 1.0) -> WhiteNull:
    """A fit of an offset and a slope to both outputs, of which the second is louder."""
    times = np.concatenate([item.times for item in RECORDS.items])
    levels = np.ones(RECORDS.size)
    levels[RECORDS.of_output(1)] = noise
    return WhiteNull(OrthogonalProjection(np.column_stack([times**0, times])).basis, levels)


def matrix(kernel: StructureKernel, rows: np.ndarray) -> np.ndarray:
    """K of the records in these rows, entry by entry."""
    result = np.zeros((RECORDS.size, RECORDS.size))
    for item in RECORDS.items:
        own = np.arange(item.rows.start, item.rows.stop)
        lags = own[:, None] - own
        values = np.exp(-0.5 * (lags / kernel.length) ** 2) * np.cos(kernel.frequency * lags)
        if np.isin(own, rows).all():
            result[np.ix_(own, own)] = np.where(np.abs(lags) <= kernel.reach(len(own)), values, 0.0)
    return result


@pytest.mark.parametrize("kernel", KERNELS)
def test_cumulants_are_those_of_the_whole_quadratic_form(kernel):
    made, rows, q = null(noise=5.0), RECORDS.of_output(1), 1.3
    form = matrix(kernel, rows)
    form[rows, rows] -= q
    fit = np.eye(RECORDS.size) - (made.basis / made.noise[:, None]) @ (
        (made.basis * made.noise[:, None]).T
    )
    whole = fit.T @ form @ fit
    powers = [np.trace(np.linalg.matrix_power(whole, m)) for m in (1, 2, 3)]
    smooth = SmoothedColumns.of(np.ones(RECORDS.size), made, RECORDS.items, kernel)
    group = [item for item in RECORDS.items if item.output == 1]
    own = traces(kernel, [len(item.times) for item in group], q)
    found = smooth.cumulants(rows, q, own)
    assert found == pytest.approx((powers[0], 2.0 * powers[1], 8.0 * powers[2]))


def test_what_a_loud_output_puts_into_a_quiet_one_is_no_structure():
    """The slope of both follows the loud one, and the quiet one is left with a ramp."""
    generator = np.random.default_rng(2)
    right, wrong = null(noise=100.0), null()
    quiet = [item for item in RECORDS.items if item.output == 0]
    found = []
    for _ in range(30):
        residuals = OrthogonalProjection(right.basis).remove(
            right.noise * generator.normal(size=RECORDS.size)
        )
        scaled = residuals / right.noise
        found.append([smoothness(scaled, [quiet], each)[0].p for each in (right, wrong)])
    p = np.array(found)
    assert np.sum(p[:, 0] < 1e-3) == 0
    assert np.mean(p[:, 1] < 1e-3) > 0.8


@pytest.mark.parametrize(
    ("period", "size"), [(300.0, 0.45), (60.0, 0.45), (31.0, 0.45), (12.0, 0.6)]
)
def test_structure_of_any_length_is_seen(period, size):
    records = stack(500, 500)
    times = np.tile(np.arange(500.0), 2)
    made = WhiteNull(np.zeros((1000, 0)), np.ones(1000))
    noise = np.random.default_rng(3).normal(size=1000)
    wave = size * np.sin(2.0 * np.pi * times / period)
    structured, white = (smoothness(r, [records.items], made)[0] for r in (noise + wave, noise))
    assert structured.p < 1e-6
    assert white.p > 0.05


def test_there_may_be_nothing_to_test():
    made = null()
    zero, none, one = stack(30), stack(0), stack(1)
    empty = WhiteNull(np.zeros((30, 0)), np.ones(30))
    assert smoothness(np.zeros(30), [zero.items], empty)[0].p == 1.0
    assert smoothness(np.zeros(RECORDS.size), [], made) == []
    for records in (none, one):
        nothing = WhiteNull(np.zeros((records.size, 0)), np.ones(records.size))
        assert smoothness(np.ones(records.size), [records.items], nothing)[0].p == 1.0
