"""Tests whether the measurements prefer a changed simulation to the fitted one.

Symbols: r are the residuals of the fit, and d is their change. P is the projection that removes
what the parameters could absorb. a is the best share of the change: 0 for the fitted simulation, 1
for the changed one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.residual_tests import autocorrelation
from workers.messages import FloatArray

BLOCKS = 30
"""Least number of time blocks of all records together."""
LEAST_BLOCKS_OF_RECORD = 4
REJECTED = 4.0
"""Least distance of the share from 0, in standard errors, to reject the fitted simulation."""
BETTER = 2.0
"""Least distance of the share above one half, in standard errors; the changed simulation then has
the smaller sum of squares."""
NEAR, COMPATIBLE = 0.3, 2.5
"""Largest distance of the share from 1, absolute or in standard errors; one of both suffices."""
LEAST_FALL = 0.01
"""Least relative decrease of the sum of squares that is reported."""
UNSEEN = 1e-9
"""Size of the projected change, over that of the change, below which it is rounding error."""


@dataclass(frozen=True)
class ChangedSimulation:
    """Comparison of a changed simulation with the fitted one.

    Attributes
    ----------
    share, error
        Best share of the change, and its standard error.
    before, after
        Sums of squares over the noise, after the parameters were adapted to the change.
    gain : (n,)
        Decrease of the square of each residual.
    """

    share: float
    error: float
    before: float
    after: float
    gain: FloatArray = field(repr=False)

    @property
    def fall(self) -> float:
        """Relative decrease of the sum of squares."""
        return 1.0 - self.after / self.before

    @property
    def rejected(self) -> bool:
        """Whether the fitted simulation is rejected, whatever the change is."""
        return self.share > REJECTED * self.error

    @property
    def preferred(self) -> bool:
        """Whether the fitted simulation is rejected, and the changed one is better and plausible.

        If the model lacks something else, the best share differs from 1.
        """
        off = abs(self.share - 1.0)
        return (
            self.rejected
            and self.share - 0.5 > BETTER * self.error
            and (off <= NEAR or off <= COMPATIBLE * self.error)
            and self.fall > LEAST_FALL
        )

    @property
    def refuted(self) -> bool:
        """Whether the changed simulation is rejected, and the fitted one is better."""
        rejected = 1.0 - self.share > REJECTED * self.error
        return rejected and 0.5 - self.share > BETTER * self.error


def compare_simulations(
    residuals: FloatArray, changed: FloatArray, jacobian: FloatArray, records: StackedRecords
) -> ChangedSimulation | None:
    """Compare a fitted simulation with a changed one at the same values of the parameters.

    The share a of the change is estimated by least squares in r = -a P d + e, which contains both
    simulations. This is the J test of R. Davidson, J. G. MacKinnon, Econometrica 49 (1981) 781-793,
    doi:10.2307/1911522; the parameters are adapted to the change to first order. The standard error
    is the largest of three: for white noise, for noise with the autocorrelation of the residuals e
    of each output, and from the sums of d e over blocks of time for any noise (A. C. Cameron, J. B.
    Gelbach, D. L. Miller, J. Bus. Econ. Stat. 29 (2011) 238-249, doi:10.1198/jbes.2010.07136, with
    blocks as clusters). If the share is above one half, the changed simulation has the smaller sum
    of squares (Q. H. Vuong, Econometrica 57 (1989) 307-333, doi:10.2307/1912557).

    Parameters
    ----------
    residuals, changed : (n,)
        Residuals of both simulations, in the order of the records.
    jacobian : (n, unknowns)
        Derivatives of the residuals at the same values.
    records
        Records of the residuals. Each output is weighted by the size of its residuals.

    Returns
    -------
    ChangedSimulation or None
        None if the parameters can absorb the change, or if no residuals remain.
    """
    weights = _weights(residuals, records)
    projection = OrthogonalProjection(jacobian * weights[:, None])
    left = projection.remove(residuals * weights)
    change = projection.remove((changed - residuals) * weights)
    square = float(np.add.reduce(change**2))
    size = float(np.add.reduce(((changed - residuals) * weights) ** 2))
    degrees = projection.degrees - 1
    if degrees < 1 or not square > UNSEEN**2 * size or not np.any(left):
        return None
    share = -float(np.add.reduce(change * left)) / square
    rest = left + share * change
    scale = len(rest) / degrees
    variance = max(_stationary(change, rest, records), _in_blocks(change * rest, records))
    after = left + change
    return ChangedSimulation(
        share=share,
        error=float(np.sqrt(scale * variance)) / square,
        before=float(np.add.reduce(left**2)),
        after=float(np.add.reduce(after**2)),
        gain=left**2 - after**2,
    )


def fall_as_good(
    before: FloatArray, after: FloatArray, records: StackedRecords, unknowns: int
) -> float:
    """Return the fall with which a model of the same unknowns is as good as a larger model.

    The measure is the Bayesian information criterion, with the weights of `compare_simulations`.

    Parameters
    ----------
    before, after : (n,)
        Residuals of the smaller and of the larger model.
    records
        Records of the residuals.
    unknowns
        Number of additional unknowns of the larger model.
    """
    weights, count = _weights(before, records), len(before)
    squares = [float(np.add.reduce((weights * each) ** 2)) for each in (before, after)]
    if not squares[0] > 0.0:
        return 0.0
    return 1.0 - squares[1] / squares[0] * float(count ** (unknowns / count))


def _weights(residuals: FloatArray, records: StackedRecords) -> FloatArray:
    """Return one over the root mean square of each output's residuals."""
    weights = np.zeros(len(residuals))
    for output in range(len(records.outputs)):
        rows = records.of_output(output)
        size = float(np.sqrt(np.mean(residuals[rows] ** 2))) if len(rows) else 0.0
        weights[rows] = 1.0 / size if size > 0.0 else 0.0
    return weights


def _stationary(change: FloatArray, rest: FloatArray, records: StackedRecords) -> float:
    """Return the variance of the sum of d e: the larger of white noise and stationary noise."""
    total = 0.0
    for output in range(len(records.outputs)):
        items = [item for item in records.items if item.output == output and len(item.times)]
        rows = records.of_output(output)
        if not len(rows):
            continue
        white = float(np.mean(rest[rows] ** 2) * np.add.reduce(change[rows] ** 2))
        longest = max(len(item.times) for item in items)
        noise, seen = np.zeros(longest), np.zeros(longest)
        for item in items:
            count = len(item.times)
            noise[:count] += _products(rest[item.rows])
            seen[:count] += _products(change[item.rows])
        end = autocorrelation(rest, items).lags + 1
        terms = noise[:end] * seen[:end] / len(rows)
        total += max(white, float(2.0 * np.add.reduce(terms) - terms[0]))
    return total


def _products(signal: FloatArray) -> FloatArray:
    """Return the sums of s_t s_{t+k} for k = 0, 1, ..."""
    padded = next_fast_len(2 * len(signal), real=True)
    spectrum = rfft(signal, padded)
    found: FloatArray = irfft(spectrum.real**2 + spectrum.imag**2, padded)[: len(signal)]
    return found


def _in_blocks(products: FloatArray, records: StackedRecords) -> float:
    """Return the sum of the squared sums over blocks of time, for all outputs together."""
    experiments = dict.fromkeys(item.experiment for item in records.items)
    count = max(LEAST_BLOCKS_OF_RECORD, -(-BLOCKS // max(len(experiments), 1)))
    total = 0.0
    for experiment in experiments:
        items = [i for i in records.items if i.experiment == experiment and len(i.times)]
        if not items:
            continue
        first = min(float(item.times[0]) for item in items)
        last = max(float(item.times[-1]) for item in items)
        ends = np.linspace(first, last, count + 1)[1:-1]
        sums = np.zeros(count)
        for item in items:
            np.add.at(sums, np.searchsorted(ends, item.times, side="right"), products[item.rows])
        total += float(np.add.reduce(sums**2))
    return total
