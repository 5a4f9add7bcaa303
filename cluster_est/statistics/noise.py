"""The measurement noise, estimated from a residual that still has structure in it."""

from __future__ import annotations

import numpy as np

from cluster_est.statistics.records import StackedRecords
from workers.messages import FloatArray

SHORTEST = 10
"""Samples that a record needs; fewer give too few differences for a median."""

GAIN = 70.0
"""Variance of a fourth difference of white noise of variance 1: 1 + 16 + 36 + 16 + 1."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| where x is normal with variance 1."""


def estimate_noise(residuals: FloatArray, records: StackedRecords) -> FloatArray:
    """Standard deviation of the noise of each output, from fourth differences.

    A fourth difference removes what is smooth over five samples (every cubic exactly) and leaves
    the noise, enlarged by a known factor: sigma = median|d4 r| / 0.6745 / sqrt(70). The median
    ignores the few differences across a jump. Differences for variances go back to J. von Neumann,
    Ann. Math. Statist. 12 (1941) 367-395, doi:10.1214/aoms/1177731677.

    Use it where the model may be wrong: the rms of the residual then measures the misfit, this
    does not. Do not where the noise is coloured, which is smooth too: the estimate is too small.

    Parameters
    ----------
    residuals : (n,)
        Stacked.

    Returns
    -------
    (outputs,)
        In the units of `residuals`. Records are pooled by their squares, weighted with their
        lengths; those under 10 samples count only where an output has no longer one, and then by
        their rms. NaN for an output without samples.
    """
    return np.array([_of_output(residuals, records, i) for i in range(len(records.outputs))])


def _of_output(residuals: FloatArray, records: StackedRecords, output: int) -> float:
    signals = [residuals[item.rows] for item in records.items if item.output == output]
    long = [signal for signal in signals if len(signal) >= SHORTEST]
    if long:
        variances = [_variance(signal) for signal in long]
        return float(np.sqrt(np.average(variances, weights=[len(signal) for signal in long])))
    total = sum(len(signal) for signal in signals)
    squares = sum(float(np.add.reduce(signal**2)) for signal in signals)
    return float(np.sqrt(squares / total)) if total else float("nan")


def _variance(signal: FloatArray) -> float:
    differences = np.diff(signal, 4)
    spread = float(np.median(np.abs(differences))) / MEDIAN_OF_NORMAL
    # coarsely quantised data repeat their values, and more than half of the differences are 0
    square = spread**2 if spread > 0.0 else float(np.mean(differences**2))
    return square / GAIN
