"""A test whether the noise of a signal grows with its size."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from cluster_est.statistics.noise.estimate import MEDIAN_OF_NORMAL
from workers.messages import FloatArray

GROWTH_DIFFERENCE_ORDER = 6
"""Order of the differences, from which the misfit of a wrong model has all but gone."""


MEDIAN_OF_SQUARE = 1.0 / 0.4549
"""A mean over the median, of the square of normal noise."""
CLIPPED, CLIPPED_MEAN = 4.0, 0.9205
"""Times its expectation that a squared difference counts at most, as an outlier's would, and the
mean of the square of normal noise that is cut off there."""
LEAST_NOISE_RATIO = 0.1
"""Part of the noise of the smallest samples that any sample has at least, however close to 0."""
MOST_GROWTH_ITERATIONS = 20


@dataclass(frozen=True)
class NoiseGrowth:
    """The dependence of noise on the size of the signal.

    Attributes
    ----------
    p
        Of a rank correlation of at least this size where the noise is the same everywhere.
    quiet, loud
        Noise of the third of the samples with the smallest signal, and with the largest.
    constant, part
        a and b of the standard deviation sqrt(a^2 + (b size)^2).
    """

    p: float
    quiet: float
    loud: float
    constant: float
    part: float


def noise_growth(residuals: FloatArray, measured: FloatArray) -> NoiseGrowth:
    """Test whether the size of the noise follows that of the signal.

    The noise at a sample is taken from the sixth difference about it, because the residual of a
    wrong model is large where the signal is, too. Differences that share samples are not
    independent, so every seventh is compared with the size of the signal there, by ranks (C.
    Spearman, Am. J. Psychol. 15 (1904) 72-101, doi:10.2307/1412159). That size is of what was
    measured, smoothed by binomial weights, of which the difference is all but independent.

    Parameters
    ----------
    residuals, measured : (n,)
        Of a record in the order of time, or several behind each other.

    Returns
    -------
    NoiseGrowth
        With p = 1 and NaN where fewer than nine differences are left, or nothing varies.
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
    from scipy.stats import spearmanr  # slow to import, and no plain fit asks for it

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
    """The two parts of the noise, by weighted least squares of the squared sixth differences.

    The expectation of each is the mean of a^2 + (b size)^2 over its seven samples, with the squares
    of the binomial coefficients as weights, and its variance is in proportion to the square of that
    (M. Davidian, R. J. Carroll, J. Am. Stat. Assoc. 82 (1987) 1079-1091,
    doi:10.1080/01621459.1987.10478543).
    """
    from scipy.optimize import nnls  # slow to import, and no plain fit asks for it

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
