"""Whether residuals are white, for smooth structure of several lengths, without random numbers.

Symbols are those of J. P. Imhof: Q the quadratic form in standard normal numbers z, k_1 to k_3 its
cumulants. r is the residual over each row's noise, A a form on it, K a kernel.
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
"""Lengths of smooth structure, in samples, that are looked for."""

WAVES = ((20.0, 0.1), (20.0, 0.2), (10.0, 0.4), (10.0, 0.6), (10.0, 0.8))
"""Lengths, in samples, and frequencies, in radians a sample, of oscillations that are looked for:
what is missing rings where the model does. Each covers the gap between its neighbours."""

SAMPLES_PER_LENGTH = 5
"""Samples that the longest record needs for each sample of a length: longer kernels see only the
mean of a record, which a shorter one sees too."""

KERNEL_CUTOFF = 4
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
class StructureKernel:
    """Covariance exp(-d^2 / 2 length^2) cos(frequency d) of samples that are d apart."""

    length: float
    frequency: float = 0.0

    def reach(self, count: int) -> int:
        """Largest lag that counts in a record of so many samples."""
        return max(0, min(int(KERNEL_CUTOFF * self.length), count - 1))

    def fits(self, count: int) -> bool:
        """Return whether a record of so many samples has room for it."""
        return SAMPLES_PER_LENGTH * self.length <= count

    def at(self, lags: IntArray) -> FloatArray:
        """Values at some lags."""
        values: FloatArray = np.exp(-0.5 * (lags / self.length) ** 2) * np.cos(
            self.frequency * lags
        )
        return values


@dataclass(frozen=True)
class WhiteNull:
    """Residuals of a linear fit to white noise: r = (I - Y W') z, z ~ N(0, I).

    With Q an orthonormal basis of the sensitivities to the parameters and S the noise's standard
    deviation of each row, the residual over the noise is S^-1 (I - Q Q') S z, hence Y = S^-1 Q and
    W = S Q. The noise of one output that was loud then explains what the fit has put into another.

    Parameters
    ----------
    basis : (n, rank)
        Q; it may have no columns.
    noise : (n,)
        The diagonal of S, the same within a record.
    """

    basis: FloatArray = field(repr=False)
    noise: FloatArray = field(repr=False)

    @cached_property
    def left(self) -> FloatArray:
        """Y, (n, rank)."""
        return self.basis / self.noise[:, None]

    @cached_property
    def square(self) -> FloatArray:
        """W'W, (rank, rank)."""
        right = self.basis * self.noise[:, None]
        return np.asarray(right.T @ right)


def smoothness(
    residuals: FloatArray, groups: Sequence[Sequence[OutputRecord]], null: WhiteNull
) -> list[SmoothnessTest]:
    """Test fitted residuals against white noise, for smooth structure of several kinds.

    For each kernel, q = r' K r / r' r over the rows of a group of records, K_ij = exp(-(i - j)^2 /
    2 length^2) cos(frequency (i - j)) between samples of one record and 0 between records: the
    locally best test against a random signal with covariance K. Its p-value, P(z' M z > 0) with M
    being A = K - q I behind the fit, follows from three cumulants k_m = 2^(m-1) (m-1)! tr M^m by
    Pearson's approximation: J. P. Imhof, Biometrika 48 (1961) 419-426,
    doi:10.1093/biomet/48.3-4.419. It does for a kernel what the test of J. Durbin and G. S. Watson
    (Biometrika 37 (1950) 409-428, doi:10.1093/biomet/37.3-4.409) does for one lag. The smallest
    over the kernels is multiplied with their number (Bonferroni).

    Below 20 degrees of freedom p-values are rough.

    Parameters
    ----------
    residuals : (n,)
        Stacked, each over the standard deviation of its row's noise; the scale of all is
        irrelevant.
    groups
        Records that are tested together.
    null
        How residuals come about where nothing is missing; n rows too.

    Returns
    -------
    list of SmoothnessTest
        One for each group; with p = 1 where there is nothing to test.
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
    """Return the kernels that records of this length have room for, the shortest always."""
    if longest < 2:
        return []
    first, *others = [
        *map(StructureKernel, WHITENESS_LENGTHS),
        *(StructureKernel(*wave) for wave in WAVES),
    ]
    return [first, *(kernel for kernel in others if kernel.fits(longest))]


@dataclass(frozen=True)
class SmoothedColumns:
    """A residual r and the null's Y with what a kernel makes of them: K r, K Y, K K Y."""

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
        """Smooth within these records."""
        smooth = smoothed(residuals[:, None], records, kernel)[:, 0]
        once = smoothed(null.left, records, kernel)
        return cls(kernel, null, residuals, smooth, once, smoothed(once, records, kernel))

    def p(self, group: Sequence[OutputRecord]) -> float:
        """Probability that white noise looks so smooth in these records."""
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
        """Of z' M z, M = (I - W Y') A (I - Y W') = A + V C V' with V = [A Y, W].

        `own` are the traces of A, A^2 and A^3.
        """
        left, once = self.null.left[rows], self.once[rows]
        variance = self.null.noise[rows, None] ** 2  # W = variance * Y, and so behind any K
        formed = once - q * left
        again = np.hstack([self.twice[rows] - 2.0 * q * once + q**2 * left, variance * formed])
        sides = np.hstack([formed, variance * left])
        rank = left.shape[1]
        inner = sides.T @ sides
        inner[rank:, rank:] = self.null.square  # W has rows outside the group too
        core = np.zeros((2 * rank, 2 * rank))
        core[:rank, rank:] = core[rank:, :rank] = -np.eye(rank)
        core[rank:, rank:] = left.T @ formed
        m, am, aam = core @ inner, core @ (sides.T @ again), core @ (again.T @ again)
        first = own[0] + np.trace(m)
        second = own[1] + 2.0 * np.trace(am) + np.trace(m @ m)
        third = own[2] + 3.0 * np.trace(aam + am @ m) + np.trace(m @ m @ m)
        return float(first), 2.0 * float(second), 8.0 * float(third)


def _above_zero(mean: float, variance: float, third: float) -> float:
    """Probability that a number with these cumulants is above 0.

    By a gamma distribution with the same cumulants. One that is skewed to the left would end at
    some number, beyond which nothing would be possible; there the normal distribution takes its
    place, whose tail is the longer one.
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
    """K times each column, (n, m); 0 in the rows of other records."""
    result = np.zeros_like(columns)
    starts: dict[int, list[int]] = {}
    for record in records:
        starts.setdefault(len(record.times), []).append(record.rows.start)
    for count, firsts in starts.items():  # records of one length at once
        reach = kernel.reach(count)
        padded = next_fast_len(count + 2 * reach, real=True)
        spectrum = rfft(kernel.at(np.arange(-reach, reach + 1)), padded)[:, None]
        rows = np.array(firsts)[:, None] + np.arange(count)
        wide = irfft(spectrum * rfft(columns[rows], padded, axis=1), padded, axis=1)
        result[rows] = wide[:, reach : reach + count]
    return result


def traces(kernel: StructureKernel, counts: Sequence[int], q: float) -> tuple[float, float, float]:
    """Traces of A, A^2 and A^3 with A = K - q I in records of these lengths.

    Those of powers of K are linear in the length of a record that has room for all lags.
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
    """For K^2 and K^3, the rise of the trace with each sample, and what its ends take off.

    A product of lags a and b has its place in a record as often as 0, a and a + b have room there,
    which reach over (|a| + |b| + |a + b|) / 2: over each of the three alike on the average. So a
    convolution of the kernel with itself has it all.
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
