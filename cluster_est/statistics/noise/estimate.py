"""Estimates the measurement noise from a residual that still has structure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from math import comb

import numpy as np
import numpy.typing as npt

from cluster_est.statistics.records import OutputRecord, StackedRecords
from workers.messages import FloatArray, IntArray

WHOLE_NUMBER_TOLERANCE = 0.01
"""Largest distance from a whole number of steps that the rounding of a table may cause."""

AGREEING = 4
"""Number of gaps that must be whole steps if few values repeat. For values that were not rounded,
the probability that all gaps are so close to whole numbers is (2 * 0.01)^4, about 2e-7."""

SHARE_OF_REPEATED_VALUES = 0.5
"""Share of repeated values above which one gap is enough, because noise in double precision never
repeats a value."""


STEP_OVER_DEVIATION = math.sqrt(12.0)
"""Ratio of a rounding step to the standard deviation of its error; see `quantisation_step`."""


def quantisation_step(values: FloatArray) -> float:
    """Return the quantisation step of a signal; 0 if it is not quantised.

    All differences of the signal are whole multiples of this step. Use the function for measured
    signals, not for residuals, because simulated values are not rounded. An offset does not matter.
    A quantised signal has an error of step / sqrt(12) if it moves across several steps (B. Widrow,
    I. Kollar, M.-C. Liu, IEEE Trans. Instrum. Meas. 45 (1996) 353-361, doi:10.1109/19.492748).

    Parameters
    ----------
    values : (n,)
        Values of one sensor, in any order.

    Returns
    -------
    float
        The smallest gap between two values, if all gaps are multiples of it; in their unit.
    """
    levels = np.unique(values)
    if len(levels) < 2:
        return 0.0
    rounding = 8.0 * np.finfo(np.float64).eps * float(np.abs(levels).max())
    gaps = np.diff(levels)
    gaps = gaps[gaps > rounding]
    if not len(gaps):
        return 0.0
    # the median of the smallest gaps, because each gap contains the rounding errors of two values
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    steps = gaps / step
    whole = np.abs(steps - np.rint(steps)) <= WHOLE_NUMBER_TOLERANCE + 2.0 * rounding / step * steps
    repeats = 1.0 - len(levels) / len(values) >= SHARE_OF_REPEATED_VALUES
    if not np.all(whole) or not (repeats or len(gaps) > AGREEING):
        return 0.0
    return step


SHORTEST_NOISE_RECORD = 10
"""Least number of samples of a record; with fewer, there are too few differences for a median."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| for a normal x with variance 1."""

NOISE_DIFFERENCE_ORDER = 4
"""Order of the differences; they remove everything that is cubic over five samples."""

HIGHER = (4, 6, 8)
"""Orders that are compared while the signal moves. With white noise, all orders give the same
estimate. With structure of more than six samples per period, higher orders give smaller ones."""

BLOCK = 32
"""Samples of a block; enough to decide from its range whether the signal moves or is at rest."""

MOVES = 0.5
"""Share of the mean range of all blocks above which the signal moves in a block."""

SURE = 4.0
"""Number of standard errors by which the noise in motion must exceed that of the whole record to
replace it. With white noise, this happens in 3 of 100,000 records."""

SCATTER = 1.9
"""Relative standard error of an estimate from n differences of order 8, times sqrt(n); for order 4
it would be 1.6."""


def estimate_noise(
    residuals: FloatArray, records: StackedRecords, measured: FloatArray | None = None
) -> FloatArray:
    """Return the standard deviation of each output's noise, from fourth differences.

    A fourth difference removes everything that is smooth over five samples (cubics exactly). The
    noise remains, enlarged by a known factor: sigma = median|d4 r| / 0.6745 / sqrt(70), where 70 is
    the number of ways to choose 4 of 8. The median ignores the few differences across a jump.
    Estimates of variances from differences go back to J. von Neumann, Ann. Math. Statist. 12 (1941)
    367-395, doi:10.1214/aoms/1177731677.

    A sensor may have little noise while its signal is at rest, and more while it moves. So a second
    estimate uses only the samples where the signal moves. It replaces the first one if it is larger
    by more than chance. A quantised signal has an error of at least step / sqrt(12)
    (`quantisation_step`), and its differences are multiples of the step. So a uniform distribution
    over one step is added before the median is taken, and its known variance is subtracted.

    Use the function if the model may be wrong: unlike the rms of the residual, the estimate does
    not contain the misfit. Do not use it for coloured noise or filtered signals, which are also
    smooth: the estimate is then too small (for an AR(1) with 0.9, a fifth of the true value).

    Parameters
    ----------
    residuals : (n,)
        Residuals of all records.
    measured : (n,)
        The measured signals in the units and order of `residuals`, from which motion and
        quantisation steps are found. None if they are not known.

    Returns
    -------
    (outputs,)
        In the units of `residuals`. The variances of records are averaged with the numbers of
        samples as weights. Records with fewer than 10 samples count only if an output has no longer
        record, and then with their rms. NaN for an output without samples.
    """
    return np.array(
        [
            _of_output(residuals, measured, [r for r in records.items if r.output == output])
            for output in range(len(records.outputs))
        ]
    )


def _of_output(
    residuals: FloatArray, measured: FloatArray | None, records: Sequence[OutputRecord]
) -> float:
    signals = [residuals[record.rows] for record in records]
    signals = [signal for signal in signals if len(signal)]
    if not signals:
        return float("nan")
    long = [record for record in records if len(record.times) >= SHORTEST_NOISE_RECORD]
    if not long:
        return float(np.sqrt(np.mean(np.concatenate(signals) ** 2)))
    signals = [residuals[record.rows] for record in long]
    if measured is None:
        return _pooled(
            [
                _variance(np.diff(signal, NOISE_DIFFERENCE_ORDER), NOISE_DIFFERENCE_ORDER)
                for signal in signals
            ],
            signals,
        )
    known = [measured[record.rows] for record in long]
    steps = [quantisation_step(values) for values in known]
    pairs = list(zip(signals, steps, strict=True))
    whole = _pooled(
        [
            _variance(np.diff(s, NOISE_DIFFERENCE_ORDER), NOISE_DIFFERENCE_ORDER, step)
            for s, step in pairs
        ],
        signals,
    )
    floor = _pooled([step**2 / 12.0 for step in steps], signals)
    return max(whole, floor, _in_motion(pairs, known, max(whole, floor)))


def _pooled(variances: Sequence[float], weights: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.average(variances, weights=[len(weight) for weight in weights])))


def _in_motion(
    pairs: Sequence[tuple[FloatArray, float]], measured: Sequence[FloatArray], whole: float
) -> float:
    """Return the noise where the signal moves, if it exceeds that of the whole record; else 0."""
    moving = moving_samples(measured)
    estimates = []
    for order in HIGHER:
        differences = [
            (np.diff(signal, order)[mask[order // 2 : len(mask) - order // 2]], step)
            for (signal, step), mask in zip(pairs, moving, strict=True)
            if len(signal) > order
        ]
        some = [
            (values, step) for values, step in differences if len(values) >= SHORTEST_NOISE_RECORD
        ]
        count = sum(len(values) for values, _ in some)
        if not count:
            return 0.0
        variances = [_variance(values, order, step) for values, step in some]
        estimates.append(_pooled(variances, [values for values, _ in some]))
    least = min(estimates)
    return least if least > whole * (1.0 + SURE * SCATTER / np.sqrt(count)) else 0.0


def moving_samples(measured: Sequence[FloatArray]) -> list[npt.NDArray[np.bool_]]:
    """Return, for each signal of one sensor, a mask of the samples in which it moves.

    Signals are cut into blocks. A signal moves in a block if the range of the middle 80 % of the
    block's values exceeds half the mean range of all blocks. So a signal that always moves, or that
    is only noise, moves in most of its blocks. All signals must have the same unit.
    """
    parts = [_block_ranges(signal) for signal in measured]
    least = MOVES * float(np.mean(np.concatenate([ranges for ranges, _ in parts])))
    return [np.repeat(ranges >= least, counts) for ranges, counts in parts]


def _block_ranges(signal: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the range of the middle 80 % of each block, and the number of samples of each block.

    Blocks have two lengths, the longer ones first. All blocks of a length are computed together.
    """
    count = max(1, len(signal) // BLOCK)
    length, longer = divmod(len(signal), count)
    cut = longer * (length + 1)
    ranges = [
        np.subtract(*np.quantile(part.reshape(-1, width), [0.9, 0.1], axis=1))
        for part, width in ((signal[:cut], length + 1), (signal[cut:], length))
        if len(part)
    ]
    counts = np.full(count, length)
    counts[:longer] += 1
    return np.concatenate(ranges), counts


def _variance(differences: FloatArray, order: int, step: float = 0.0) -> float:
    """Return the variance of the noise from its differences."""
    gain = comb(2 * order, order)
    if step > 0.0:
        spread = _dithered_median(differences, step) / MEDIAN_OF_NORMAL
        return max(spread**2 - step**2 / 12.0, 0.0) / gain
    spread = float(np.median(np.abs(differences))) / MEDIAN_OF_NORMAL
    # coarsely quantised data repeat values, so more than half of the differences may be 0
    square = spread**2 if spread > 0.0 else float(np.mean(differences**2))
    return square / gain


def _dithered_median(differences: FloatArray, step: float) -> float:
    """Return the median of |d + u|, where u is uniform over one step around 0."""
    low, high = 0.0, float(np.abs(differences).max()) + step
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = np.clip((middle - differences) / step + 0.5, 0.0, 1.0)
        below -= np.clip((-middle - differences) / step + 0.5, 0.0, 1.0)
        low, high = (middle, high) if np.mean(below) < 0.5 else (low, middle)
    return 0.5 * (low + high)
