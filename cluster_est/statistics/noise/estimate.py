"""The measurement noise, estimated from a residual that still has structure in it."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np
import numpy.typing as npt

from cluster_est.statistics.records import OutputRecord, StackedRecords
from workers.messages import FloatArray, IntArray

WHOLE_NUMBER_TOLERANCE = 0.01
"""Distance from a whole number, in steps, that the rounding of a table's digits may leave."""

AGREEING = 4
"""Gaps that must be whole steps where hardly a value repeats: those of values that were not rounded
all come so close to whole numbers with a probability of (2 * 0.01)^4, about 2e-7."""

SHARE_OF_REPEATED_VALUES = 0.5
"""Share of samples that repeat a value beyond which one gap is enough: noise in a double never
repeats one."""


def quantisation_step(values: FloatArray) -> float:
    """Return the step of which all differences of a signal are whole multiples; 0 without one.

    Use it on what was measured, not on a residual: what was simulated is not rounded. An offset
    does not matter. A quantised signal has an error of its own, step / sqrt(12) where it moves
    across several steps (B. Widrow, I. Kollar, M.-C. Liu, IEEE Trans. Instrum. Meas. 45 (1996)
    353-361, doi:10.1109/19.492748).

    Parameters
    ----------
    values : (n,)
        Of one sensor, in any order.

    Returns
    -------
    float
        In the unit of `values`. The smallest gap between two values, if all gaps are multiples.
    """
    levels = np.unique(values)
    if len(levels) < 2:
        return 0.0
    rounding = 8.0 * np.finfo(np.float64).eps * float(np.abs(levels).max())
    gaps = np.diff(levels)
    gaps = gaps[gaps > rounding]
    if not len(gaps):
        return 0.0
    # the median of the smallest ones: each of them has the rounding of two values
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    steps = gaps / step
    whole = np.abs(steps - np.rint(steps)) <= WHOLE_NUMBER_TOLERANCE + 2.0 * rounding / step * steps
    repeats = 1.0 - len(levels) / len(values) >= SHARE_OF_REPEATED_VALUES
    if not np.all(whole) or not (repeats or len(gaps) > AGREEING):
        return 0.0
    return step


SHORTEST_NOISE_RECORD = 10
"""Samples that a record needs; fewer give too few differences for a median."""

MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| where x is normal with variance 1."""

NOISE_DIFFERENCE_ORDER = 4
"""Order of the differences: what is cubic over five samples leaves nothing."""

HIGHER = (4, 6, 8)
"""Orders that are compared where the signal moves: white noise has the same size in all of them,
and structure with more than six samples a period less in each than in the one before."""

BLOCK = 32
"""Samples of a block that is at rest or moves: enough for its range to say which."""

MOVES = 0.5
"""Share of the mean range of all blocks from which a block counts as one that moves."""

SURE = 4.0
"""Standard errors by which the noise in motion must exceed that of the whole record to take its
place: on white noise that happens in 3 of 100,000 records."""

SCATTER = 1.9
"""Standard error of an estimate from n differences of order 8, times sqrt(n); 1.6 at order 4."""


def estimate_noise(
    residuals: FloatArray, records: StackedRecords, measured: FloatArray | None = None
) -> FloatArray:
    """Standard deviation of the noise of each output, from fourth differences.

    A fourth difference removes what is smooth over five samples (every cubic exactly) and leaves
    the noise, enlarged by a known factor: sigma = median|d4 r| / 0.6745 / sqrt(70), where 70 is
    the number of ways to choose 4 of 8. The median ignores the few differences across a jump.
    Differences for variances go back to J. von Neumann, Ann. Math. Statist. 12 (1941) 367-395,
    doi:10.1214/aoms/1177731677.

    A sensor may be silent while its signal rests, and noisy while it moves. So the same is
    estimated where the signal moves, and takes the place of the first estimate where it is
    larger by more than chance: a residual is compared with the noise of a moving signal. A
    quantised signal has an error of step / sqrt(12) at least (see `quantisation_step`), and its
    differences are multiples of the step: the median is that of these differences plus an even
    spread over one step, whose known variance is subtracted.

    Use it where the model may be wrong: the rms of the residual then measures the misfit, this
    does not. Do not where the noise is coloured, which is smooth too: the estimate is too small
    (for an AR(1) of 0.9 a fifth of the truth), as it is of a signal that was filtered.

    Parameters
    ----------
    residuals : (n,)
        Stacked.
    measured : (n,)
        The measured signals in the units of `residuals`, in the same order: they tell motion from
        rest and have the steps of quantisation. None if they are unknown.

    Returns
    -------
    (outputs,)
        In the units of `residuals`. Records are pooled by their squares, weighted with their
        lengths; those under 10 samples count only where an output has no longer one, and then by
        their rms. NaN for an output without samples.
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
    """The noise where the signal moves, if it exceeds that of the whole record; 0 otherwise."""
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
    """For each signal of one sensor, in which samples it moves.

    Parameters
    ----------
    measured
        Signals in the same unit. A signal is cut into blocks; one whose middle 80 % reach over
        half the mean of all blocks moves. So what moves all the time, or is nothing but noise,
        moves in most of its blocks.
    """
    parts = [_block_ranges(signal) for signal in measured]
    least = MOVES * float(np.mean(np.concatenate([ranges for ranges, _ in parts])))
    return [np.repeat(ranges >= least, counts) for ranges, counts in parts]


def _block_ranges(signal: FloatArray) -> tuple[FloatArray, IntArray]:
    """Over how much the middle 80 % of each block reach, and the samples of each block.

    Blocks are of two lengths, the longer ones first, and all of a length are looked at together.
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
    """The variance of the noise whose differences these are."""
    gain = comb(2 * order, order)
    if step > 0.0:
        spread = _dithered_median(differences, step) / MEDIAN_OF_NORMAL
        return max(spread**2 - step**2 / 12.0, 0.0) / gain
    spread = float(np.median(np.abs(differences))) / MEDIAN_OF_NORMAL
    # coarsely quantised data repeat their values, and more than half of the differences are 0
    square = spread**2 if spread > 0.0 else float(np.mean(differences**2))
    return square / gain


def _dithered_median(differences: FloatArray, step: float) -> float:
    """Median of |d + u|, where u is spread evenly over one step about 0."""
    low, high = 0.0, float(np.abs(differences).max()) + step
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = np.clip((middle - differences) / step + 0.5, 0.0, 1.0)
        below -= np.clip((-middle - differences) / step + 0.5, 0.0, 1.0)
        low, high = (middle, high) if np.mean(below) < 0.5 else (low, middle)
    return 0.5 * (low + high)
