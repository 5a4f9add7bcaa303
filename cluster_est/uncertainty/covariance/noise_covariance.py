"""The covariance of estimates for white noise, autocorrelated noise, and scatter of experiments.

Least-squares estimates have the covariance (J'J)^-1 J'SJ (J'J)^-1, where S is the covariance of the
noise. There are three models of S:

- The variance of the residuals times the identity. It is correct only for white noise.
- An autoregression for each output (see `fit_noise`). It is correct for noise that is correlated in
  time, for any number of experiments.
- The products of the residuals within each experiment. This is the sandwich of K.-Y. Liang, S. L.
  Zeger, Biometrika 73 (1986) 13-22, doi:10.1093/biomet/73.1.13, with E / (E - 1) for E experiments
  and E - 1 degrees of freedom. It includes all differences between experiments. It is inaccurate
  for few experiments, and has no information on unknowns of a single experiment.

The intervals use the autoregression; for white noise, this is the first model. The third model
replaces it if the experiments differ by more than chance.

The autocovariances of the noise are estimated from residuals, from which the fit has removed a part
of the noise. Symbols: e is the noise with covariance S, Q an orthonormal basis of the fitted
directions, and r = (1 - QQ') e are the residuals. c_h are the sums of r_t r_{t+h} over all records
of an output, g_h the autocovariances of its noise, and a the coefficients of its autoregression.
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
"""Least number of samples in the longest record for each order. At longer lags, the part of the
noise that the fit removed cannot be determined."""
PENALTY = 6.635
"""Least penalty for each further order: the 1 % level of chi-squared with one degree of freedom."""
MOST_AUTOCOVARIANCE_ITERATIONS = 100
SETTLED = 1e-3
"""Change of the autocovariances, over the variance, at which the iteration has converged."""
NEGLIGIBLE_AUTOCOVARIANCE = 1e-6
"""Size of negligible autocovariances, over the variance."""
REFLECTION = 0.999
"""Largest partial autocorrelation; above it, the variance of the noise cannot be determined."""
MOST_PRODUCTS = 2e6
"""Largest number of rows times fitted directions for which the loss by the fit is corrected. With
more rows, the loss is negligible."""


@dataclass(frozen=True)
class NoiseRecord:
    """A record of one output, with samples in the order of time.

    Attributes
    ----------
    output
        Index of the output.
    residuals : (n,)
        Weighted residuals.
    fitted : (n, k)
        The record's rows of Q: first the shared directions, then those of its experiment.
    experiment
        Index of the experiment.
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
        The coefficients a; empty for white noise.
    covariances : (lags,)
        g_0, g_1, ..., without negligible values at the end.
    variance_error
        Relative variance of the estimated spectrum of the noise at frequency 0.
    """

    coefficients: FloatArray
    covariances: FloatArray
    variance_error: float

    def times(self, columns: FloatArray) -> FloatArray:
        """Return S times the columns of one record."""
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

    A fit follows the slow part of coloured noise, so the residuals are less correlated than the
    noise. The expectation is

        E c_h = tr(T_h (1 - QQ') S (1 - QQ')),    T_h the products at lag h.

    It is solved for S by iteration: the expected loss of c_h by the fit is added to the measured
    c_h. These are the moments of restricted maximum likelihood (H. D. Patterson, R. Thompson,
    Biometrika 58 (1971) 545-554, doi:10.1093/biomet/58.3.545). The order p minimises
    n log s^2 + max(log n, 6.6) p (G. Schwarz, Ann. Stat. 6 (1978) 461-464,
    doi:10.1214/aos/1176344136). So at most one of a hundred white outputs is found to be coloured.

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
    """The sums c_h of an output, their numbers of products, and its longest record's length."""

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
        """Return the autoregression of the best order; `lost` is the loss of c_h by the fit."""
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

    This is the Levinson-Durbin recursion. It ends at the first order that is not stationary.
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
    """Return g_h of an autoregression at all lags of a record, without a negligible end."""
    order = len(coefficients)
    known = covariances[: order + 1]
    if not order:
        return known
    size = max(longest, order + 1)
    bands = np.tile(np.append(1.0, -coefficients)[:, None], size)
    for lag in range(1, order + 1):
        bands[lag, : order + 1 - lag] = 0.0  # rows of known values
    found = solve_banded((order, 0), bands, np.append(known, np.zeros(size - order - 1)))
    felt = np.flatnonzero(np.abs(found) >= NEGLIGIBLE_AUTOCOVARIANCE * found[0])
    return found[: max(int(felt[-1]) + 1, order + 1)] if len(felt) else known


def _spectrum_error(
    coefficients: FloatArray, variance: float, covariances: FloatArray, count: float
) -> float:
    """Return the relative variance of s^2 / (1 - a_1 - ... - a_p)^2, to first order.

    The estimates of a have the covariance s^2 G^-1 / n, where G has the entries g_|i-j| (P. J.
    Brockwell, R. A. Davis, Time Series: Theory and Methods (1991), doi:10.1007/978-1-4419-0320-4,
    section 8.1).
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
    """Return the expected loss of c_h by the fit, for each output."""
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
    """Return the sums over rows and columns of one_t other_{t+h} for h = 0 to lags - 1."""
    size = next_fast_len(len(one) + lags, real=True)
    spectra = rfft(one, size, axis=0).conj() * rfft(other, size, axis=0)
    return np.asarray(irfft(spectra.sum(axis=1), size)[:lags])


def _close(one: AutoregressiveNoise, other: AutoregressiveNoise) -> bool:
    size = min(len(one.covariances), len(other.covariances), LONGEST_ORDER)
    change = np.abs(one.covariances[:size] - other.covariances[:size]).max()
    alike = len(one.coefficients) == len(other.coefficients)
    return bool(alike and change <= SETTLED * other.covariances[0])


FEW_EXPERIMENTS = 10
"""Least number of experiments for intervals from their scatter; with fewer, it is only reported."""
NOISE_OF_PRIORS = AutoregressiveNoise(np.zeros(0), np.ones(1), 0.0)
"""The noise of priors: a known variance of 1."""
SCATTER_SIGNIFICANCE = 0.01
"""Largest p-value of the scatter of experiments for which intervals use it."""


class NoiseBasis(StrEnum):
    """The noise model of the standard errors."""

    WHITE = "white"
    AUTOREGRESSION = "autoregression"
    EXPERIMENTS = "experiments"


@dataclass(frozen=True)
class EstimateCovariance:
    """The covariance of scaled unknowns, and its degrees of freedom."""

    basis: NoiseBasis
    blocks: BlockCovariance = field(repr=False)
    degrees: float


@dataclass(frozen=True)
class WeightedResiduals:
    """Residuals with the row weights of the factorised Jacobian.

    Attributes
    ----------
    values : (n,)
        Weighted residuals; empty if they are not known.
    outputs : (n,)
        Output of each residual.
    rows
        Rows of each experiment.
    priors : (n,)
        Whether each residual is that of a prior, whose standard deviation is 1.
    """

    values: FloatArray
    outputs: IntArray
    rows: tuple[slice, ...]
    priors: npt.NDArray[np.bool_]


def white_covariance(
    factors: BlockFactors, spread: Sequence[FloatArray] | None, variance: float, degrees: int
) -> EstimateCovariance:
    """Return the covariance for white noise; for `spread`, see `system.ResidualScatter`."""
    diagonals = None if spread is None else [_diagonal(row) for row in spread]
    blocks = block_covariance(factors, diagonals).times(variance)
    return EstimateCovariance(NoiseBasis.WHITE, blocks, degrees)


def coloured_covariances(
    white: EstimateCovariance, factors: BlockFactors, residuals: WeightedResiduals
) -> tuple[EstimateCovariance, ...]:
    """Return the covariances for noise that is not white, if there are any.

    The covariance for autocorrelated noise is left out if the noise of no output is autocorrelated.
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
    """Return the covariance for the intervals; the first argument is that of white noise."""
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
    """Return F with F F' equal to `factors.inverse`, so that `rest` F is orthonormal."""
    values, vectors = np.linalg.eigh(factors.inverse)
    kept = values > 1e-14 * max(values.max(initial=0.0), 0.0)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def _records(factors: BlockFactors, residuals: WeightedResiduals) -> list[NoiseRecord]:
    """Split the residuals into records, each with its rows of the fitted directions."""
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
    """Return the covariance from the scatter of the experiments; None if it is not available.

    Unknowns of a single experiment keep their covariance from the noise, plus the change that comes
    from the shared unknowns. With priors, the scatter is not available, because priors shift the
    estimates of all experiments in the same direction.
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
    """Return a function that multiplies by the covariance of one experiment's records."""

    def product(columns: FloatArray) -> FloatArray:
        result, first = np.empty_like(columns), 0
        for noise, length in records:
            rows = slice(first, first + length)
            result[rows] = noise.times(columns[rows])
            first += length
        return result

    return product
