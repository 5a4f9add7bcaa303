"""The omnibus test sees any smooth structure, and only that."""

import numpy as np
import pytest
from scipy.stats import kstest
from support.truth.stacked_noise import stack

from cluster_est.statistics.omnibus import LENGTHS, omnibus
from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.records import StackedRecords
from workers.messages import FloatArray, IntArray

RECORDS = stack(150, 100, 3, 1)
TREND = np.concatenate([item.times for item in RECORDS.items])
SENSITIVITIES = np.column_stack([np.ones(RECORDS.size), TREND])


def test_p_is_uniform_under_the_null() -> None:
    generator = np.random.default_rng(20)
    projection = OrthogonalProjection(SENSITIVITIES)
    p = np.array(
        [
            omnibus(projection, generator.standard_normal(RECORDS.size), RECORDS, generator, 200).p
            for _ in range(200)
        ]
    )
    assert kstest(p, "uniform").pvalue > 0.01
    assert 0.02 <= float((p < 0.05).mean()) <= 0.09


def test_what_the_parameters_explain_is_no_structure() -> None:
    noise = np.random.default_rng(22).standard_normal(RECORDS.size)
    projection = OrthogonalProjection(SENSITIVITIES)
    shifted = noise + SENSITIVITIES @ np.array([50.0, -80.0])
    alone = omnibus(projection, noise, RECORDS, np.random.default_rng(0))
    both = omnibus(projection, -1e6 * shifted, RECORDS, np.random.default_rng(0))
    assert both.z == pytest.approx(alone.z, rel=1e-6)
    assert both.p == alone.p
    assert omnibus(projection, np.zeros(RECORDS.size), RECORDS, np.random.default_rng(0)).p == 1.0
    exact = omnibus(projection, SENSITIVITIES @ np.ones(2), RECORDS, np.random.default_rng(0))
    assert exact.p == 1.0


def standardised(signal: FloatArray, kernel: FloatArray, rows: IntArray) -> float:
    """x'Kx / x'x above its mean in standard deviations, by its exact moments in normal noise."""
    x, own, n = signal[rows], kernel[np.ix_(rows, rows)], len(rows)
    trace = np.trace(own)
    square = (2.0 * np.trace(own @ own) + trace**2) / (n * (n + 2.0))
    mean = trace / n
    return float((x @ own @ x / (x @ x) - mean) / np.sqrt(square - mean**2))


@pytest.mark.parametrize("records", [stack(40, 0, 25), stack(13, 1, outputs=2), stack(500, 100)])
def test_the_statistic_is_that_of_the_kernel(records: StackedRecords) -> None:
    """The largest of all lengths and of each output alone; the longest takes draws in chunks."""
    signal = np.random.default_rng(24).standard_normal(records.size).cumsum()
    expected = []
    for length in LENGTHS:
        kernel = np.zeros((records.size, records.size))
        for item in records.items:
            lags = np.subtract.outer(item.times, item.times) * (len(item.times) - 1)
            near = np.abs(lags) <= 4.0 * length + 0.5
            kernel[item.rows, item.rows] = np.exp(-0.5 * (lags / length) ** 2) * near
        rows = [np.arange(records.size), *map(records.of_output, range(len(records.outputs)))]
        expected += [standardised(signal, kernel, own) for own in rows]
    nothing = OrthogonalProjection(np.zeros((records.size, 0)))
    found = omnibus(nothing, signal, records, np.random.default_rng(0), draws=6000)
    assert found.z == pytest.approx(max(expected), rel=0.04)


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_structure_in_one_of_many_outputs_is_seen_whatever_its_scale(scale: float) -> None:
    records = stack(60, 60, 60, outputs=12)
    rows = records.of_output(7)
    wave = np.sin(2.0 * np.pi * np.arange(len(rows)) / 30.0)
    nothing = OrthogonalProjection(np.zeros((records.size, 0)))
    for seed in range(5):  # among the noise of all 12, the wave is missed in some of these
        generator = np.random.default_rng(seed)
        residuals = generator.standard_normal(records.size)
        residuals[rows] = scale * (residuals[rows] + wave)
        assert omnibus(nothing, residuals, records, generator).p <= 0.01


def test_an_output_of_which_nothing_is_left_is_no_structure() -> None:
    records = stack(80, 80, outputs=2)
    residuals = np.random.default_rng(26).standard_normal(records.size)
    residuals[records.of_output(0)] = 0.0
    found = omnibus(OrthogonalProjection(np.zeros((records.size, 0))), residuals, records,
                    np.random.default_rng(0))  # fmt: skip
    assert np.isfinite(found.z)
    assert found.p > 0.01
