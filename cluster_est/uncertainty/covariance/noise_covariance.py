"""The covariance of estimates under white noise, autocorrelated noise, and scatter of experiments.

Least squares estimates have the covariance (J'J)^-1 J'SJ (J'J)^-1, S being that of the noise. Taken
for S here are

- the variance of the residuals times 1: right for white noise alone;
- an autoregression for each output (see `fit_noise`): right for noise that is correlated in
  time, however few experiments there are;
- the products of the residuals within each experiment: the sandwich of K.-Y. Liang, S. L. Zeger,
  Biometrika 73 (1986) 13-22, doi:10.1093/biomet/73.1.13, with E / (E - 1) for E experiments and
  E - 1 degrees of freedom. It sees all that makes experiments differ, but little of it where they
  are few, and nothing of the unknowns that only one experiment has.

The intervals are those of the autoregression, which is the first where the noise is white. The
third takes its place where the experiments differ by more than chance.

The autocovariances of the noise come from residuals that have lost some of it to the fit. Symbols:
e the noise with covariance S, Q an orthonormal basis of the directions that were fitted, r = (1 -
QQ') e the residuals, c_h the sums of r_t r_{t+h} over all records of an output, g_h the
autocovariances of its noise, a the coefficients of the autoregression that they are given by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import solve_banded
from scipy.special import chdtrc

from cluster_est.uncertainty.covariance.normal_equations import (
    BlockCovariance,
    BlockFactors,
    block_covariance,
)
from workers.messages import FloatArray, IntArray

LONGEST_ORDER = 20
SAMPLES_PER_ORDER = 10
"""Samples of the longest record for each order that is tried: over longer lags, what a fit has
taken of the noise cannot be distinguished from what the noise lacks."""
PENALTY = 6.635
"""Least gain for each further order: the 1 % level of a chi-square of one degree."""
MOST_AUTOCOVARIANCE_ITERATIONS = 100
SETTLED = 1e-3
"""Change of the autocovariances, over the variance, at which they have settled."""
NEGLIGIBLE_AUTOCOVARIANCE = 1e-6
"""Autocovariances below this, over the variance, are 0 from there on."""
REFLECTION = 0.999
"""Largest partial autocorrelation: beyond it the variance of a noise is unknown."""
MOST_PRODUCTS = 2e6
"""Rows times fitted directions, above which what the fit took is not corrected for: so many rows
lose too little for it to matter."""


@dataclass(frozen=True)
class NoiseRecord:
    """A record of one output: samples that follow each other in time.

    Attributes
    ----------
    output
        Which output.
    residuals : (n,)
        Over the square roots of their weights.
    fitted : (n, k)
        The record's rows of Q: of the shared directions, then of those of its experiment alone.
    experiment
        Which experiment.
    """

    output: int
    residuals: FloatArray = field(repr=False)
    fitted: FloatArray = field(repr=False)
    experiment: int


@dataclass(frozen=True)
class AutoregressiveNoise:
    """The noise of one output as an autoregression.

    Attributes
    ----------
    coefficients : (order,)
        a; none of them for white noise.
    covariances : (lags,)
        g_0, g_1, ..., up to where they are negligible.
    variance_error
        Relative variance of the estimate of the noise's spectrum at frequency 0.
    """

    coefficients: FloatArray
    covariances: FloatArray
    variance_error: float

    def times(self, columns: FloatArray) -> FloatArray:
        """Return S times columns of one record."""
        length = len(columns)
        lags = self.covariances[:length]
        size = next_fast_len(length + len(lags), real=True)
        kernel = np.zeros(size)
        kernel[: len(lags)] = lags
        kernel[size - len(lags) + 1 :] += lags[:0:-1]
        spectrum = rfft(kernel).real[:, None] * rfft(columns, size, axis=0)
        return np.asarray(irfft(spectrum, size, axis=0)[:length])


def fit_noise(records: Sequence[NoiseRecord], shared: int) -> dict[int, AutoregressiveNoise]:
    """Fit an autoregression to the noise of each output.

    A fit follows the slow part of coloured noise, so that its residuals are less correlated than
    the noise was. In expectation,

        E c_h = tr(T_h (1 - QQ') S (1 - QQ')),    T_h the products at lag h,

    which is solved for S by iteration: the difference of E c_h and of what c_h would be without
    the fit is added to the c_h that were seen (the moments of restricted maximum likelihood; H. D.
    Patterson, R. Thompson, Biometrika 58 (1971) 545-554, doi:10.1093/biomet/58.3.545). The order
    has the least n log s^2 + max(log n, 6.6) p (G. Schwarz, Ann. Stat. 6 (1978) 461-464,
    doi:10.1214/aos/1176344136, with no more than one white output in a hundred called coloured).

    Parameters
    ----------
    records
        All records of all outputs.
    shared
        Number of shared directions, the first columns of `NoiseRecord.fitted`.
    """
    outputs = sorted({record.output for record in records})
    own = {output: [r for r in records if r.output == output] for output in outputs}
    seen = {output: _Products.of(own[output]) for output in outputs}
    found = {output: seen[output].noise(0.0) for output in outputs}
    if sum(record.fitted.size for record in records) > MOST_PRODUCTS:
        return found
    for _ in range(MOST_AUTOCOVARIANCE_ITERATIONS):
        lost = _lost_products(records, found, shared, {o: seen[o].lags for o in outputs})
        before, found = found, {o: seen[o].noise(lost[o]) for o in outputs}
        if all(_close(before[output], found[output]) for output in outputs):
            break
    return found


@dataclass(frozen=True)
class _Products:
    """c_h of one output, how many products each is the sum of, and its longest record's samples."""

    sums: FloatArray
    counts: FloatArray
    longest: int

    @classmethod
    def of(cls, records: Sequence[NoiseRecord]) -> _Products:
        longest = max(len(record.residuals) for record in records)
        lags = 1 + min(LONGEST_ORDER, longest // SAMPLES_PER_ORDER)
        sums, counts = np.zeros(lags), np.zeros(lags)
        for record in records:
            column = record.residuals[:, None]
            sums += _correlated(column, column, lags)
            counts += np.maximum(len(column) - np.arange(lags), 0)
        return cls(sums, counts, longest)

    @property
    def lags(self) -> int:
        return len(self.sums)

    def noise(self, lost: FloatArray | float) -> AutoregressiveNoise:
        """Return the autoregression of the best order, `lost` being what the fit took of c_h."""
        covariances = (self.sums + lost) / self.counts
        count = self.counts[0]
        penalty = max(float(np.log(count)), PENALTY)
        best, least = (np.zeros(0), float(covariances[0])), np.inf
        for coefficients, variance in _predictors(covariances):
            criterion = count * np.log(variance) + penalty * len(coefficients)
            if criterion < least:
                best, least = (coefficients, variance), criterion
        coefficients, variance = best
        error = _spectrum_error(coefficients, variance, covariances, count)
        extended = _extended(coefficients, covariances, self.longest)
        return AutoregressiveNoise(coefficients, extended, error)


def _predictors(covariances: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return the predictors of order 0, 1, ... and the variances of their errors.

    The Levinson-Durbin recursion, up to the first order that is not stationary.
    """
    coefficients, variance = np.zeros(0), float(covariances[0])
    if not variance > 0.0:
        return []
    found = [(coefficients, variance)]
    for order in range(1, len(covariances)):
        rest = covariances[order] - coefficients @ covariances[order - 1 : 0 : -1]
        reflection = float(rest) / variance
        if not abs(reflection) <= REFLECTION:
            break
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        variance *= 1.0 - reflection**2
        found.append((coefficients, variance))
    return found


def _extended(coefficients: FloatArray, covariances: FloatArray, longest: int) -> FloatArray:
    """Return g_h of an autoregression at all lags of a record, or to where they stay negligible."""
    order = len(coefficients)
    known = covariances[: order + 1]
    if not order:
        return known
    size = max(longest, order + 1)
    bands = np.tile(np.append(1.0, -coefficients)[:, None], size)
    for lag in range(1, order + 1):
        bands[lag, : order + 1 - lag] = 0.0  # rows of what is known
    found = solve_banded((order, 0), bands, np.append(known, np.zeros(size - order - 1)))
    felt = np.flatnonzero(np.abs(found) >= NEGLIGIBLE_AUTOCOVARIANCE * found[0])
    return found[: max(int(felt[-1]) + 1, order + 1)] if len(felt) else known


def _spectrum_error(
    coefficients: FloatArray, variance: float, covariances: FloatArray, count: float
) -> float:
    """Return the relative variance of s^2 / (1 - a_1 - ... - a_p)^2, to first order.

    The estimates of a have the covariance s^2 G^-1 / n, G having g_|i-j|: P. J. Brockwell, R. A.
    Davis, Time Series: Theory and Methods (1991), doi:10.1007/978-1-4419-0320-4, section 8.1.
    """
    order = len(coefficients)
    own = 2.0 / count
    if not order:
        return own
    lags = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    spread = variance * float(np.linalg.solve(covariances[lags], np.ones(order)).sum())
    return own + 4.0 * spread / (count * (1.0 - float(coefficients.sum())) ** 2)


def _lost_products(
    records: Sequence[NoiseRecord],
    noise: dict[int, AutoregressiveNoise],
    shared: int,
    lags: dict[int, int],
) -> dict[int, FloatArray]:
    """Return how much less than without a fit c_h of each output is in expectation."""
    products = [noise[record.output].times(record.fitted) for record in records]
    forms: dict[int, FloatArray] = {}
    common = np.zeros((shared, shared))
    for record, product in zip(records, products, strict=True):
        form = record.fitted.T @ product
        forms[record.experiment] = forms.get(record.experiment, 0.0) + form
        common += form[:shared, :shared]
    for form in forms.values():
        form[:shared, :shared] = common
    lost = {output: np.zeros(count) for output, count in lags.items()}
    for record, product in zip(records, products, strict=True):
        count = lags[record.output]
        mixed = record.fitted @ forms[record.experiment]
        lost[record.output] += (
            _correlated(record.fitted, product, count)
            + _correlated(product, record.fitted, count)
            - _correlated(record.fitted, mixed, count)
        )
    return lost


def _correlated(one: FloatArray, other: FloatArray, lags: int) -> FloatArray:
    """Return the sums over rows and columns of one_t other_{t+h}, h = 0 ... lags - 1."""
    size = next_fast_len(len(one) + lags, real=True)
    spectra = rfft(one, size, axis=0).conj() * rfft(other, size, axis=0)
    return np.asarray(irfft(spectra.sum(axis=1), size)[:lags])


def _close(one: AutoregressiveNoise, other: AutoregressiveNoise) -> bool:
    size = min(len(one.covariances), len(other.covariances), LONGEST_ORDER)
    change = np.abs(one.covariances[:size] - other.covariances[:size]).max()
    alike = len(one.coefficients) == len(other.coefficients)
    return bool(alike and change <= SETTLED * other.covariances[0])


FEW_EXPERIMENTS = 10
"""Below so many experiments their scatter is reported, but no interval rests on it."""
NOISE_OF_PRIORS = AutoregressiveNoise(np.zeros(0), np.ones(1), 0.0)
"""The noise of priors: a variance of 1, that nothing was estimated for."""
SCATTER_SIGNIFICANCE = 0.01
"""Probability of as much scatter of the experiments, over that of the noise, by chance."""


class NoiseBasis(StrEnum):
    """What the standard errors rest on."""

    WHITE = "white"
    AUTOREGRESSION = "autoregression"
    EXPERIMENTS = "experiments"


@dataclass(frozen=True)
class EstimateCovariance:
    """The covariance of scaled unknowns, and the degrees of freedom of its size."""

    basis: NoiseBasis
    blocks: BlockCovariance = field(repr=False)
    degrees: float


@dataclass(frozen=True)
class WeightedResiduals:
    """Residuals over the square roots of their weights, as the factorised Jacobian has its rows.

    Attributes
    ----------
    values : (n,)
        None of them where they are not known.
    outputs : (n,)
        The output of each.
    rows
        Of each experiment.
    priors : (n,)
        Whether each is that of a prior, whose standard deviation is 1.
    """

    values: FloatArray
    outputs: IntArray
    rows: tuple[slice, ...]
    priors: npt.NDArray[np.bool_]


def white_covariance(
    factors: BlockFactors, spread: Sequence[FloatArray] | None, variance: float, degrees: int
) -> EstimateCovariance:
    """Return the covariance for white noise; `spread` as in `weighting.ResidualScatter`."""
    diagonals = None if spread is None else [_diagonal(row) for row in spread]
    blocks = block_covariance(factors, diagonals).times(variance)
    return EstimateCovariance(NoiseBasis.WHITE, blocks, degrees)


def coloured_covariances(
    white: EstimateCovariance, factors: BlockFactors, residuals: WeightedResiduals
) -> tuple[EstimateCovariance, ...]:
    """Return the covariances that do not take the noise for white, as far as there are any.

    The one for autocorrelated noise is left out where no output's noise is.
    """
    if not len(residuals.values) or not white.degrees > 0:
        return ()
    records = _records(factors, residuals)
    of_priors = set(residuals.outputs[residuals.priors].tolist())
    measured = [record for record in records if record.output not in of_priors]
    noise = fit_noise(measured, _basis(factors).shape[1])
    noise |= dict.fromkeys(of_priors, NOISE_OF_PRIORS)
    coloured = any(len(each.coefficients) for each in noise.values())
    found = [_autoregressive(white, factors, records, noise)] if coloured else []
    scatter = _scatter(found[0] if found else white, factors, residuals)
    return (*found, *(() if scatter is None else (scatter,)))


def most_honest(covariances: Sequence[EstimateCovariance]) -> EstimateCovariance:
    """Return the covariance that the intervals are made of; the first is that of white noise."""
    noise = [each for each in covariances if each.basis is not NoiseBasis.EXPERIMENTS][-1]
    last = covariances[-1]
    if last.basis is not NoiseBasis.EXPERIMENTS or last.degrees + 1 < FEW_EXPERIMENTS:
        return noise
    ours, theirs = np.diag(last.blocks.shared), np.diag(noise.blocks.shared)
    known = theirs > 0.0
    ratios = ours[known] / theirs[known]
    p = chdtrc(last.degrees, last.degrees * ratios)
    return last if np.min(p, initial=1.0) * len(ratios) < SCATTER_SIGNIFICANCE else noise


def _basis(factors: BlockFactors) -> FloatArray:
    """Return F with F F' = `factors.inverse`, so that `rest` F is orthonormal."""
    values, vectors = np.linalg.eigh(factors.inverse)
    kept = values > 1e-14 * max(values.max(initial=0.0), 0.0)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def _records(factors: BlockFactors, residuals: WeightedResiduals) -> list[NoiseRecord]:
    """Cut the residuals into records, each with its rows of the directions that were fitted."""
    basis = _basis(factors)
    found = []
    for e, (part, rows) in enumerate(zip(factors.parts, residuals.rows, strict=True)):
        left, _, _ = np.linalg.svd(part.inverse.T, full_matrices=False)
        fitted = np.hstack([part.rest @ basis, left[:, : part.rank]])
        values, outputs = residuals.values[rows], residuals.outputs[rows]
        ends = [0, *(np.flatnonzero(np.diff(outputs)) + 1), len(outputs)]
        found += [
            NoiseRecord(int(outputs[a]), values[a:b], fitted[a:b], e)
            for a, b in pairwise(ends)
            if b > a
        ]
    return found


def _autoregressive(
    white: EstimateCovariance,
    factors: BlockFactors,
    records: Sequence[NoiseRecord],
    noise: dict[int, AutoregressiveNoise],
) -> EstimateCovariance:
    own: dict[int, list[tuple[AutoregressiveNoise, int]]] = {
        e: [] for e in range(len(factors.parts))
    }
    for record in records:
        own[record.experiment].append((noise[record.output], len(record.residuals)))
    blocks = block_covariance(factors, [_autocorrelated(own[e]) for e in sorted(own)])
    count = sum(len(record.residuals) for record in records)
    coloured = [each.variance_error for each in noise.values() if len(each.coefficients)]
    degrees = max(1.0, 2.0 / max(coloured) * white.degrees / count)
    return EstimateCovariance(NoiseBasis.AUTOREGRESSION, blocks, min(degrees, white.degrees))


def _scatter(
    noise: EstimateCovariance, factors: BlockFactors, residuals: WeightedResiduals
) -> EstimateCovariance | None:
    """Return the covariance from the scatter of the experiments; None where it says nothing.

    What the noise alone says of unknowns that one experiment has stays; they follow the others.
    Priors pull all experiments one way, so that with them the scatter is no error.
    """
    count, unknowns = len(factors.parts), len(factors.inverse)
    if not unknowns or count <= unknowns + 1 or residuals.priors.any():
        return None
    shared = np.zeros_like(factors.inverse)
    for part, rows in zip(factors.parts, residuals.rows, strict=True):
        moved = factors.inverse @ (part.rest.T @ residuals.values[rows])
        shared += np.outer(moved, moved)
    shared *= count / (count - 1)
    change = shared - noise.blocks.shared
    pairs = list(zip(factors.parts, noise.blocks.cross, noise.blocks.local, strict=True))
    blocks = BlockCovariance(
        shared,
        tuple(cross - part.response @ change for part, cross, _ in pairs),
        tuple(local + part.response @ change @ part.response.T for part, _, local in pairs),
    )
    return EstimateCovariance(NoiseBasis.EXPERIMENTS, blocks, count - 1)


def _diagonal(values: FloatArray) -> Callable[[FloatArray], FloatArray]:
    return lambda columns: values[:, None] * columns


def _autocorrelated(
    records: Sequence[tuple[AutoregressiveNoise, int]],
) -> Callable[[FloatArray], FloatArray]:
    """Return the product with the covariance of one experiment's records."""

    def product(columns: FloatArray) -> FloatArray:
        result, first = np.empty_like(columns), 0
        for noise, length in records:
            rows = slice(first, first + length)
            result[rows] = noise.times(columns[rows])
            first += length
        return result

    return product
