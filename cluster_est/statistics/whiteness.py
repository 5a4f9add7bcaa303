"""Whether residuals are white, for smooth structure of several lengths, without random numbers.

Symbols are those of J. P. Imhof: Q the quadratic form in standard normal numbers z, k_1 to k_3 its
cumulants. r is the residual over each row's noise, A a form on it, K a kernel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import gamma, norm

from cluster_est.statistics.records import OutputRecord
from workers.messages import FloatArray, IntArray

LENGTHS = (1.0, 2.0, 6.0, 20.0, 60.0)
"""Lengths of smooth structure, in samples, that are looked for."""

SAMPLES_PER_LENGTH = 5
"""Samples that the longest record needs for each sample of a length: longer kernels see only the
mean of a record, which a shorter one sees too."""

REACH = 4
"""Lengths after which a Gaussian kernel is cut off."""

NEARLY_NORMAL = 1e-3
"""Skewness below which a normal distribution is exact enough."""


@dataclass(frozen=True)
class SmoothnessTest:
    """The smoothness of residuals beside that of white noise.

    Attributes
    ----------
    p
        Probability that white noise looks at least as smooth.
    length
        Of the structure that is least likely to be noise, in samples.
    """

    p: float
    length: float


@dataclass(frozen=True)
class WhiteNull:
    """Residuals of a linear fit to white noise: r = (I - Y W') z, z ~ N(0, I).

    With Q an orthonormal basis of the sensitivities to the parameters and S the noise's standard
    deviation of each row, the residual over the noise is S^-1 (I - Q Q') S z, hence Y = S^-1 Q and
    W = S Q. The noise of one output that was loud then explains what the fit has put into another.

    Attributes
    ----------
    left, right : (n, rank)
        Y and W.
    """

    left: FloatArray = field(repr=False)
    right: FloatArray = field(repr=False)

    @classmethod
    def of(cls, basis: FloatArray, noise: FloatArray) -> WhiteNull:
        """Make it of Q (n, rank) and the diagonal of S (n,)."""
        return cls(basis / noise[:, None], basis * noise[:, None])


@dataclass(frozen=True)
class QuadraticForm:
    """A = K - q I in the rows of some records, and 0 in all others."""

    records: Sequence[OutputRecord]
    rows: IntArray
    length: float
    q: float

    def times(self, columns: FloatArray) -> FloatArray:
        """A times columns (n, m)."""
        result = smoothed(columns, self.records, self.length)
        result[self.rows] -= self.q * columns[self.rows]
        return result


def smoothness(
    residuals: FloatArray, records: Sequence[OutputRecord], null: WhiteNull
) -> SmoothnessTest:
    """Test fitted residuals against white noise, for smooth structure of several lengths.

    For each length, q = r' K r / r' r over the rows of `records`, K_ij = exp(-(i - j)^2 / 2
    length^2) between samples of one record and 0 between records: the locally best test against a
    random signal with covariance K. Its p-value, P(z' M z > 0) with M being A = K - q I behind the
    fit, follows from three cumulants k_m = 2^(m-1) (m-1)! tr M^m by Pearson's approximation:
    J. P. Imhof, Biometrika 48 (1961) 419-426, doi:10.1093/biomet/48.3-4.419. It does for a kernel
    what the test of J. Durbin and G. S. Watson (Biometrika 37 (1950) 409-428,
    doi:10.1093/biomet/37.3-4.409) does for one lag. The smallest over the lengths is multiplied
    with their number (Bonferroni).

    Use it, rather than `omnibus`, where small p-values must be told apart or no random numbers are
    wanted.

    Parameters
    ----------
    residuals : (n,)
        Stacked, each over the standard deviation of its row's noise; the scale of all is
        irrelevant.
    records
        Those that are tested together.
    null
        How residuals come about where nothing is missing; n rows too.

    Returns
    -------
    SmoothnessTest
        With p = 1 where there is nothing to test.
    """
    parts = [np.arange(record.rows.start, record.rows.stop) for record in records]
    rows = np.concatenate([np.zeros(0, dtype=int), *parts])
    square = float(np.add.reduce(residuals[rows] ** 2))
    longest = max((len(record.times) for record in records), default=0)
    lengths = [x for x in LENGTHS if x == LENGTHS[0] or SAMPLES_PER_LENGTH * x <= longest]
    if square == 0.0 or longest < 2:
        return SmoothnessTest(1.0, LENGTHS[0])
    found = []
    for length in lengths:
        smooth = smoothed(residuals[:, None], records, length)[:, 0]
        q = float(np.add.reduce((residuals * smooth)[rows])) / square
        form = QuadraticForm(records, rows, length, q)
        found.append((_above_zero(*_cumulants(form, null)), length))
    smallest, length = min(found)
    return SmoothnessTest(min(1.0, len(lengths) * smallest), length)


def _cumulants(form: QuadraticForm, null: WhiteNull) -> tuple[float, float, float]:
    """Of z' M z with M = (I - W Y') A (I - Y W') = A + V C V', V = [A Y, W]."""
    rank = null.left.shape[1]
    formed = form.times(null.left)
    sides = np.hstack([formed, null.right])
    again = form.times(sides)
    core = np.zeros((2 * rank, 2 * rank))
    core[:rank, rank:] = core[rank:, :rank] = -np.eye(rank)
    core[rank:, rank:] = null.left.T @ formed
    once = core @ (sides.T @ sides)
    twice = core @ (sides.T @ again)
    thrice = core @ (again.T @ again)
    first, second, third = traces(form)
    first += np.trace(once)
    second += 2.0 * np.trace(twice) + np.trace(once @ once)
    third += 3.0 * np.trace(thrice + twice @ once) + np.trace(once @ once @ once)
    return float(first), 2.0 * float(second), 8.0 * float(third)


def _above_zero(mean: float, variance: float, third: float) -> float:
    """Probability that a number with these cumulants is above 0, by a gamma distribution."""
    if variance <= 0.0:
        return 1.0
    x, skewness = -mean / np.sqrt(variance), third / variance**1.5
    if abs(skewness) < NEARLY_NORMAL:
        return float(norm.sf(x))
    shape = 4.0 / skewness**2
    place = shape + np.sign(skewness) * x * np.sqrt(shape)
    return float(gamma.sf(place, shape) if skewness > 0.0 else gamma.cdf(place, shape))


def smoothed(columns: FloatArray, records: Sequence[OutputRecord], length: float) -> FloatArray:
    """K times each column, (n, m); 0 in the rows of other records."""
    result = np.zeros_like(columns)
    for record in records:
        count = len(record.times)
        kernel = _kernel(length, count)
        reach = len(kernel) // 2
        padded = next_fast_len(count + 2 * reach, real=True)
        spectrum = rfft(kernel, padded)[:, None]
        wide = irfft(spectrum * rfft(columns[record.rows], padded, axis=0), padded, axis=0)
        result[record.rows] = wide[reach : reach + count]
    return result


def _kernel(length: float, count: int) -> FloatArray:
    """Values of the kernel at the lags -reach ... reach."""
    reach = max(0, min(int(REACH * length), count - 1))
    kernel: FloatArray = np.exp(-0.5 * (np.arange(-reach, reach + 1) / length) ** 2)
    return kernel


def traces(form: QuadraticForm) -> tuple[float, float, float]:
    """Traces of A, A^2 and A^3."""
    length, q = form.length, form.q
    first = second = third = 0.0
    for count, times in Counter(len(record.times) for record in form.records).items():
        if not count:
            continue
        kernel = _kernel(length, count)
        reach = len(kernel) // 2
        lags = np.arange(-reach, reach + 1)
        first += times * count
        second += times * float(np.add.reduce(kernel**2 * (count - np.abs(lags))))
        a, b = lags[:, None], lags[None, :]
        both = a + b
        span = np.maximum(np.maximum(a, both), 0) - np.minimum(np.minimum(a, both), 0)
        product = kernel[:, None] * kernel * np.exp(-0.5 * (both / length) ** 2)
        product[np.abs(both) > reach] = 0.0
        third += times * float(np.add.reduce((product * np.maximum(count - span, 0)).ravel()))
    return (
        first * (1.0 - q),
        second - 2.0 * q * first + q**2 * first,
        third - 3.0 * q * second + 3.0 * q**2 * first - q**3 * first,
    )
