"""The covariance of estimates under white noise, autocorrelated noise, and scatter of experiments.

Least squares estimates have the covariance (J'J)^-1 J'SJ (J'J)^-1, S being that of the noise. Taken
for S here are

- the variance of the residuals times 1: right for white noise alone;
- an autoregression for each output (see `autoregression`): right for noise that is correlated in
  time, however few experiments there are;
- the products of the residuals within each experiment: the sandwich of K.-Y. Liang, S. L. Zeger,
  Biometrika 73 (1986) 13-22, doi:10.1093/biomet/73.1.13, with E / (E - 1) for E experiments and
  E - 1 degrees of freedom. It sees all that makes experiments differ, but little of it where they
  are few, and nothing of the unknowns that only one experiment has.

The intervals are those of the autoregression, which is the first where the noise is white. The
third takes its place where the experiments differ by more than chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc

from cluster_est.uncertainty.covariance.autoregression import (
    AutoregressiveNoise,
    NoiseRecord,
    fit_noise,
)
from cluster_est.uncertainty.covariance.blocks import (
    BlockCovariance,
    BlockFactors,
    block_covariance,
)
from workers.messages import FloatArray, IntArray

FEW_EXPERIMENTS = 10
"""Below so many experiments their scatter is reported, but no interval rests on it."""
KNOWN = AutoregressiveNoise(np.zeros(0), np.ones(1), 0.0)
"""Of priors: a variance of 1, that nothing was estimated for."""
CHANCE = 0.01
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
    noise |= dict.fromkeys(of_priors, KNOWN)
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
    return last if np.min(p, initial=1.0) * len(ratios) < CHANCE else noise


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
