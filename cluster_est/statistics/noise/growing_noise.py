"""A test whether the noise of a signal grows with its size."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from cluster_est.statistics.noise.estimate import MEDIAN_OF_NORMAL
from workers.messages import FloatArray

GROWTH_DIFFERENCE_ORDER = 6
"""Order of the differences; they contain almost nothing of the misfit of a wrong model."""


MEDIAN_OF_SQUARE = 1.0 / 0.4549
"""Ratio of mean to median of the square of normal noise."""
CLIPPED, CLIPPED_MEAN = 4.0, 0.9205
"""Upper limit of a squared difference, over its expectation, which reduces the influence of
outliers; mean of the square of normal noise with this limit."""
LEAST_NOISE_RATIO = 0.1
"""Least noise of each sample, even near 0, as a share of the noise of the smallest samples."""
MOST_GROWTH_ITERATIONS = 20


@dataclass(frozen=True)
class NoiseGrowth:
    """The dependence of noise on the size of the signal.

    Attributes
    ----------
    p
        p-value of the rank correlation, for constant noise.
    quiet, loud
        Noise of the third of the samples with the smallest signal, and of that with the largest.
    constant, part
        a and b of the standard deviation sqrt(a^2 + (b size)^2).
    """

    p: float
    quiet: float
    loud: float
    constant: float
    part: float


def noise_growth(residuals: FloatArray, measured: FloatArray) -> NoiseGrowth:
    """Test whether the noise grows with the size of the signal.

    The noise at a sample is estimated by the sixth difference around it, because the residual of a
    wrong model may also be large where the signal is large. Differences that share samples are not
    independent, so only every seventh one is used. Its rank correlation with the size of the signal
    is tested (C. Spearman, Am. J. Psychol. 15 (1904) 72-101, doi:10.2307/1412159). The size is that
    of the measured signal, smoothed with binomial weights, so that it is almost independent of the
    difference.

    Parameters
    ----------
    residuals, measured : (n,)
        Signals of one record in the order of time, or of several records one after the other.

    Returns
    -------
    NoiseGrowth
        With p = 1 and NaN if there are fewer than nine differences, or if nothing varies.
    """
    nothing = NoiseGrowth(1.0, *[float("nan")] * 4)
    if len(residuals) <= GROWTH_DIFFERENCE_ORDER:
        return nothing
    noise = np.abs(np.diff(residuals, GROWTH_DIFFERENCE_ORDER))[:: GROWTH_DIFFERENCE_ORDER + 1]
    size = _smoothed_size(measured)
    centre = size[GROWTH_DIFFERENCE_ORDER // 2 : len(size) - GROWTH_DIFFERENCE_ORDER // 2][
        :: GROWTH_DIFFERENCE_ORDER + 1
    ]
    if len(noise) < 9 or not np.ptp(noise) > 0.0 or not np.ptp(centre) > 0.0:
        return nothing
    from scipy.stats import spearmanr  # slow to import, and a plain fit does not need it

    found = spearmanr(noise, centre, alternative="greater")
    order = np.argsort(centre, kind="stable")
    third = len(order) // 3
    gain = MEDIAN_OF_NORMAL * np.sqrt(comb(2 * GROWTH_DIFFERENCE_ORDER, GROWTH_DIFFERENCE_ORDER))
    ends = order[:third], order[-third:]
    quiet, loud = (float(np.median(noise[rows])) / gain for rows in ends)
    constant, part = _parts(residuals, size)
    return NoiseGrowth(
        float(found.pvalue), quiet, loud, max(constant, LEAST_NOISE_RATIO * quiet), part
    )


def _smoothed_size(measured: FloatArray) -> FloatArray:
    weights = (
        np.array([comb(GROWTH_DIFFERENCE_ORDER, k) for k in range(GROWTH_DIFFERENCE_ORDER + 1)])
        / 2.0**GROWTH_DIFFERENCE_ORDER
    )
    padded = np.pad(measured, GROWTH_DIFFERENCE_ORDER // 2, mode="edge")
    return np.abs(np.convolve(padded, weights, "valid"))


def _parts(residuals: FloatArray, size: FloatArray) -> tuple[float, float]:
    """Return the two parts of the noise: weighted least squares for squared sixth differences.

    The expectation of a squared difference is the mean of a^2 + (b size)^2 over its seven samples,
    weighted with the squares of the binomial coefficients. Its variance is proportional to the
    square of this expectation (M. Davidian, R. J. Carroll, J. Am. Stat. Assoc. 82 (1987) 1079-1091,
    doi:10.1080/01621459.1987.10478543).
    """
    from scipy.optimize import nnls  # slow to import, and a plain fit does not need it

    weights = np.array(
        [comb(GROWTH_DIFFERENCE_ORDER, k) ** 2 for k in range(GROWTH_DIFFERENCE_ORDER + 1)]
    ) / comb(2 * GROWTH_DIFFERENCE_ORDER, GROWTH_DIFFERENCE_ORDER)
    squares = np.diff(residuals, GROWTH_DIFFERENCE_ORDER) ** 2 / comb(
        2 * GROWTH_DIFFERENCE_ORDER, GROWTH_DIFFERENCE_ORDER
    )
    largest = float(size.max())
    terms = np.column_stack(
        [np.ones(len(squares)), np.convolve((size / largest) ** 2, weights, "valid")]
    )
    expected = np.full(len(squares), float(np.median(squares)) * MEDIAN_OF_SQUARE)
    found = np.zeros(2)
    for _ in range(MOST_GROWTH_ITERATIONS):
        expected = np.maximum(expected, 1e-12 * float(squares.max()))
        clipped = np.minimum(squares, CLIPPED * expected) / CLIPPED_MEAN
        found, _ = nnls(terms / expected[:, None], clipped / expected)
        expected = terms @ found
    return float(np.sqrt(found[0])), float(np.sqrt(found[1])) / largest
