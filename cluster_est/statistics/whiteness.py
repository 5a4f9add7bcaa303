"""Tests whether residuals are white or have smooth structure, without random numbers.

The symbols are those of J. P. Imhof: Q is the quadratic form in standard normal numbers z, and k_1
to k_3 are its cumulants. r is the residual over each row's noise, A a quadratic form of r, and K a
kernel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import gammaincc, ndtr

from cluster_est.statistics.records import OutputRecord
from workers.messages import FloatArray, IntArray

WHITENESS_LENGTHS = (1.0, 2.0, 6.0, 20.0, 60.0)
"""Tested lengths of smooth structure in samples."""

WAVES = ((20.0, 0.1), (20.0, 0.2), (10.0, 0.4), (10.0, 0.6), (10.0, 0.8))
"""Lengths in samples and frequencies in radians per sample of the tested oscillations. A missing
effect may excite oscillations of the model. Their frequency bands overlap."""

SAMPLES_PER_LENGTH = 5
"""Least number of samples in the longest record, over the length of a kernel. Longer kernels detect
only the mean of a record, which a shorter kernel also detects."""

KERNEL_CUTOFF = 4
"""Lag, in lengths, above which a Gaussian kernel is set to 0."""

NEARLY_NORMAL = 1e-3
"""Skewness below which the normal distribution is sufficiently accurate."""


@dataclass(frozen=True)
class SmoothnessTest:
    """The smoothness of residuals compared with white noise.

    Attributes
    ----------
    p
        Probability that white noise is at least as smooth.
    length
        Length in samples of the structure that is least likely to be noise.
    """

    p: float
    length: float


@dataclass(frozen=True)
class StructureKernel:
    """The covariance exp(-d^2 / 2 length^2) cos(frequency d) of samples with the lag d."""

    length: float
    frequency: float = 0.0

    def reach(self, count: int) -> int:
        """Return the largest lag that counts in a record with this number of samples."""
        return max(0, min(int(KERNEL_CUTOFF * self.length), count - 1))

    def fits(self, count: int) -> bool:
        """Return whether a record with this number of samples is long enough for the kernel."""
        return SAMPLES_PER_LENGTH * self.length <= count

    def at(self, lags: IntArray) -> FloatArray:
        """Return the values at some lags."""
        values: FloatArray = np.exp(-0.5 * (lags / self.length) ** 2) * np.cos(
            self.frequency * lags
        )
        return values


@dataclass(frozen=True)
class WhiteNull:
    """Residuals of a linear fit to white noise: r = (I - Y W') z, z ~ N(0, I).

    Q is an orthonormal basis of the sensitivities to the parameters, and S contains the standard
    deviation of each row's noise. The residual over the noise is S^-1 (I - Q Q') S z, so Y = S^-1 Q
    and W = S Q. This includes the influence of one output's noise on the residuals of another.

    Parameters
    ----------
    basis : (n, rank)
        The basis Q; it may have no columns.
    noise : (n,)
        The diagonal of S, which is constant within a record.
    """

    basis: FloatArray = field(repr=False)
    noise: FloatArray = field(repr=False)

    @cached_property
    def left(self) -> FloatArray:
        """The matrix Y: (n, rank)."""
        return self.basis / self.noise[:, None]

    @cached_property
    def square(self) -> FloatArray:
        """The matrix W'W: (rank, rank)."""
        right = self.basis * self.noise[:, None]
        return np.asarray(right.T @ right)


def smoothness(
    residuals: FloatArray, groups: Sequence[Sequence[OutputRecord]], null: WhiteNull
) -> list[SmoothnessTest]:
    """Test fitted residuals against white noise, for smooth structure of several kinds.

    For each kernel, the statistic is q = r' K r / r' r over the rows of a group of records, with
    K_ij = exp(-(i - j)^2 / 2 length^2) cos(frequency (i - j)) between samples of one record and 0
    between records. This is the locally best test against a random signal with covariance K. Its
    p-value is P(z' M z > 0), where M is A = K - q I transformed by the fit. It follows from the
    three cumulants k_m = 2^(m-1) (m-1)! tr M^m by Pearson's approximation (J. P. Imhof, Biometrika
    48 (1961) 419-426, doi:10.1093/biomet/48.3-4.419). The test is analogous to that of J. Durbin
    and G. S. Watson for one lag (Biometrika 37 (1950) 409-428, doi:10.1093/biomet/37.3-4.409). The
    smallest p-value of all kernels is multiplied by their number (Bonferroni).

    Below 20 degrees of freedom, p-values are inaccurate.

    Parameters
    ----------
    residuals : (n,)
        Stacked residuals, each over the standard deviation of its noise; a common scale is
        irrelevant.
    groups
        Groups of records that are tested together.
    null
        The residuals of a correct model, also with n rows.

    Returns
    -------
    list of SmoothnessTest
        One for each group; p = 1 if nothing can be tested.
    """
    records = list({r.rows.start: r for group in groups for r in group if len(r.times)}.values())
    found: list[list[tuple[float, float]]] = [[] for _ in groups]
    longest = [max((len(record.times) for record in group), default=0) for group in groups]
    for kernel in _kernels(max(longest, default=0)):
        smooth = SmoothedColumns.of(residuals, null, records, kernel)
        for number, group in enumerate(groups):
            if kernel.length == WHITENESS_LENGTHS[0] or kernel.fits(longest[number]):
                found[number].append((smooth.p(group), kernel.length))
    return [_smallest(each) for each in found]


def _smallest(found: Sequence[tuple[float, float]]) -> SmoothnessTest:
    if not found:
        return SmoothnessTest(1.0, WHITENESS_LENGTHS[0])
    p, length = min(found)
    return SmoothnessTest(min(1.0, len(found) * p), length)


def _kernels(longest: int) -> list[StructureKernel]:
    """Return the kernels for which records of this length are long enough, always the shortest."""
    if longest < 2:
        return []
    first, *others = [
        *map(StructureKernel, WHITENESS_LENGTHS),
        *(StructureKernel(*wave) for wave in WAVES),
    ]
    return [first, *(kernel for kernel in others if kernel.fits(longest))]


@dataclass(frozen=True)
class SmoothedColumns:
    """A residual r and the matrix Y of the null, with their products K r, K Y and K K Y."""

    kernel: StructureKernel
    null: WhiteNull
    residuals: FloatArray = field(repr=False)
    smooth: FloatArray = field(repr=False)
    once: FloatArray = field(repr=False)
    twice: FloatArray = field(repr=False)

    @classmethod
    def of(
        cls,
        residuals: FloatArray,
        null: WhiteNull,
        records: Sequence[OutputRecord],
        kernel: StructureKernel,
    ) -> SmoothedColumns:
        """Return the products within these records."""
        smooth = smoothed(residuals[:, None], records, kernel)[:, 0]
        once = smoothed(null.left, records, kernel)
        return cls(kernel, null, residuals, smooth, once, smoothed(once, records, kernel))

    def p(self, group: Sequence[OutputRecord]) -> float:
        """Return the probability that white noise is at least as smooth in these records."""
        parts = [np.arange(record.rows.start, record.rows.stop) for record in group]
        rows = np.concatenate([np.zeros(0, dtype=int), *parts])
        square = float(np.add.reduce(self.residuals[rows] ** 2))
        if square == 0.0:
            return 1.0
        q = float(np.add.reduce(self.residuals[rows] * self.smooth[rows])) / square
        counts = [len(record.times) for record in group]
        return _above_zero(*self.cumulants(rows, q, traces(self.kernel, counts, q)))

    def cumulants(
        self, rows: IntArray, q: float, own: tuple[float, float, float]
    ) -> tuple[float, float, float]:
        """Return the cumulants of z' M z.

        M = (I - W Y') A (I - Y W') = A + V C V' with V = [A Y, W]. `own` are the traces of A, A^2
        and A^3.
        """
        left, once = self.null.left[rows], self.once[rows]
        variance = self.null.noise[rows, None] ** 2  # W = variance * Y, also after products with K
        formed = once - q * left
        again = np.hstack([self.twice[rows] - 2.0 * q * once + q**2 * left, variance * formed])
        sides = np.hstack([formed, variance * left])
        rank = left.shape[1]
        inner = sides.T @ sides
        inner[rank:, rank:] = self.null.square  # W also has rows outside the group
        core = np.zeros((2 * rank, 2 * rank))
        core[:rank, rank:] = core[rank:, :rank] = -np.eye(rank)
        core[rank:, rank:] = left.T @ formed
        m, am, aam = core @ inner, core @ (sides.T @ again), core @ (again.T @ again)
        first = own[0] + np.trace(m)
        second = own[1] + 2.0 * np.trace(am) + np.trace(m @ m)
        third = own[2] + 3.0 * np.trace(aam + am @ m) + np.trace(m @ m @ m)
        return float(first), 2.0 * float(second), 8.0 * float(third)


def _above_zero(mean: float, variance: float, third: float) -> float:
    """Return the probability that a random number with these cumulants is above 0.

    A gamma distribution with the same cumulants is used. If it were skewed to the left, it would
    have an upper limit, so the normal distribution with its longer tail is used instead.
    """
    if variance <= 0.0:
        return 1.0
    x, skewness = -mean / np.sqrt(variance), third / variance**1.5
    if skewness < NEARLY_NORMAL:
        return float(ndtr(-x))
    shape = 4.0 / skewness**2
    return float(gammaincc(shape, shape + x * np.sqrt(shape)))


def smoothed(
    columns: FloatArray, records: Sequence[OutputRecord], kernel: StructureKernel
) -> FloatArray:
    """Return K times each column, (n, m); 0 in the rows of other records."""
    result = np.zeros_like(columns)
    starts: dict[int, list[int]] = {}
    for record in records:
        starts.setdefault(len(record.times), []).append(record.rows.start)
    for count, firsts in starts.items():  # all records of one length together
        reach = kernel.reach(count)
        padded = next_fast_len(count + 2 * reach, real=True)
        spectrum = rfft(kernel.at(np.arange(-reach, reach + 1)), padded)[:, None]
        rows = np.array(firsts)[:, None] + np.arange(count)
        wide = irfft(spectrum * rfft(columns[rows], padded, axis=1), padded, axis=1)
        result[rows] = wide[:, reach : reach + count]
    return result


def traces(kernel: StructureKernel, counts: Sequence[int], q: float) -> tuple[float, float, float]:
    """Return the traces of A, A^2 and A^3 with A = K - q I, for records of these lengths.

    The traces of powers of K are linear in the length of a record that contains all lags.
    """
    first = second = third = 0.0
    for count, times in Counter(counts).items():
        reach = kernel.reach(count)
        squares, cubes = _diagonals(kernel, reach)
        first += times * count
        second += times * (count * squares[0] - squares[1])
        third += times * (count * cubes[0] - cubes[1])
    return (
        first * (1.0 - q),
        second - 2.0 * q * first + q**2 * first,
        third - 3.0 * q * second + 3.0 * q**2 * first - q**3 * first,
    )


@lru_cache(maxsize=256)
def _diagonals(
    kernel: StructureKernel, reach: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return, for K^2 and K^3, the increase of the trace per sample and the loss at the ends.

    A product with the lags a and b occurs as often as 0, a and a + b fit into a record. They span
    (|a| + |b| + |a + b|) / 2 samples, to which the three terms contribute equally on average. So a
    convolution of the kernel with itself suffices.
    """
    lags = np.arange(-reach, reach + 1)
    values = kernel.at(lags)
    padded = next_fast_len(4 * reach + 1, real=True)
    twice = irfft(rfft(values, padded) ** 2, padded)[reach : 3 * reach + 1]
    product = values * twice
    squares = values**2
    return (
        (float(np.add.reduce(squares)), float(np.add.reduce(squares * np.abs(lags)))),
        (
            float(np.add.reduce(product)),
            float(np.add.reduce(1.5 * product * np.abs(lags))),
        ),
    )
