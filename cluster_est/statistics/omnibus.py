"""Omnibus test for smooth structure in the residual, whatever its shape.

Symbols are those of a locally best test: Q the quadratic form, K the covariance, r the residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len, rfft

from cluster_est.statistics.projection import NOTHING_LEFT, OrthogonalProjection
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whiteness import KERNEL_CUTOFF
from workers.messages import FloatArray

NULL_DISTRIBUTION_DRAWS = 400
"""Draws of the null distribution: a p-value of 0.01 needs some hundred."""

OMNIBUS_LENGTHS = (2.0, 6.0, 20.0)
"""Lengths of smooth structure, in samples, that are looked for."""


NUMBERS_AT_ONCE = 2_500_000
"""Random numbers held at once: 20 MB, and their spectra about three times that."""


@dataclass(frozen=True)
class OmnibusTest:
    """The smoothness of a residual beside that of white noise.

    Attributes
    ----------
    p
        Share of white residuals that look at least as smooth.
    z
        The largest statistic, in standard deviations of its null distribution above its mean.
    """

    p: float
    z: float


def omnibus(
    projection: OrthogonalProjection,
    residuals: FloatArray,
    records: StackedRecords,
    generator: np.random.Generator,
    draws: int = NULL_DISTRIBUTION_DRAWS,
    lengths: Sequence[float] = OMNIBUS_LENGTHS,
) -> OmnibusTest:
    """Test the residual against white noise for every smooth alternative at once.

    For each length, Q = r' K r / r' r with r the projected residual and K_ij = exp(-(i - j)^2 / 2
    length^2) between samples of one record, 0 between records: the locally best test against a
    random signal with covariance K. Each output is also looked at alone, or the noise of many would
    hide what is in one. Q is standardised by its null distribution, the statistic is the largest
    over the lengths and the outputs, and its p-value is counted among white noise that went through
    the same projection and the same maximum.

    It needs no candidates, so it also fires where nothing in a library explains the residual; where
    one does, `score.family_wise` sees smaller effects. Coloured noise is smooth structure too.

    Parameters
    ----------
    residuals : (n,)
        Stacked; their scale is irrelevant.
    draws
        Simulated residuals under the null; the smallest p is 1 / (draws + 1).
    lengths
        In samples.
    """
    observed = projection.remove(residuals)
    if np.linalg.norm(observed) <= NOTHING_LEFT * np.linalg.norm(residuals):
        return OmnibusTest(1.0, 0.0)
    null = _null(projection, records, generator, draws, lengths)
    mean, spread = null.mean(axis=0), null.std(axis=0)
    spread[spread == 0.0] = 1.0
    largest = ((null - mean) / spread).max(axis=1)
    z = float(((_smoothness(observed[None], records, lengths)[0] - mean) / spread).max())
    return OmnibusTest((1 + int((largest >= z).sum())) / (draws + 1), z)


def _null(
    projection: OrthogonalProjection,
    records: StackedRecords,
    generator: np.random.Generator,
    draws: int,
    lengths: Sequence[float],
) -> FloatArray:
    """Q of projected white noise, (draws, statistics)."""
    rows = max(1, NUMBERS_AT_ONCE // max(records.size, 1))
    found = []
    for start in range(0, draws, rows):
        noise = generator.standard_normal((min(rows, draws - start), records.size))
        found.append(_smoothness(projection.remove(noise.T).T, records, lengths))
    return np.concatenate(found)


def _smoothness(
    signals: FloatArray, records: StackedRecords, lengths: Sequence[float]
) -> FloatArray:
    """Q of each row of `signals`: for each length, over all outputs and then for each alone.

    (rows, lengths), or where there are several outputs (rows, lengths * (1 + outputs)).
    """
    quadratic = np.zeros((len(records.outputs), len(signals), len(lengths)))
    squares = np.zeros((len(records.outputs), len(signals), 1))
    for item in records.items:
        count = len(item.times)
        if not count:
            continue
        reaches = [min(int(KERNEL_CUTOFF * length), count - 1) for length in lengths]
        padded = next_fast_len(count + max(reaches), real=True)
        spectra = rfft(signals[:, item.rows], padded, axis=1)
        power = spectra.real**2 + spectra.imag**2
        pairs = zip(lengths, reaches, strict=True)
        weights = np.stack([_weights(*pair, padded) for pair in pairs], axis=1)
        quadratic[item.output] += power @ weights
        squares[item.output, :, 0] += (signals[:, item.rows] ** 2).sum(axis=1)
    found = [quadratic.sum(axis=0) / squares.sum(axis=0)]
    if len(records.outputs) > 1:
        found += list(quadratic / np.where(squares > 0.0, squares, 1.0))
    return np.concatenate(found, axis=1)


def _weights(length: float, reach: int, padded: int) -> FloatArray:
    """Factors of the power spectrum whose sum is r' K r (Parseval): no transform back is needed.

    `padded` exceeds a record by the kernel's reach, so that its two ends do not meet.
    """
    kernel = np.zeros(padded)
    lags = np.arange(-reach, reach + 1)
    kernel[lags] = np.exp(-0.5 * (lags / length) ** 2)
    weights: FloatArray = rfft(kernel).real / padded
    # a real signal's spectrum stores one of each two mirrored frequencies, but for the first and,
    # at an even number, the last
    weights[1 : (padded + 1) // 2] *= 2.0
    return weights
