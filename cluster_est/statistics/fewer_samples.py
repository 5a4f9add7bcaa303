"""Describes the input signals of a model by fewer samples."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from workers.messages import FloatArray, IntArray

ROUNDS = 12
"""Largest number of refinements of the intervals in which the error is too large."""

NOISY = 6.0
"""Additional tolerance of straight lines, in standard deviations of the signal's noise."""

HELD_FAST = 1e-6
"""Weight of the signal at each knot, over that of a sample; it fixes knots without samples."""


def without_repeats(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a held signal without samples that repeat the one before; the signal is the same."""
    kept = np.concatenate([[True], values[1:] != values[:-1]])
    return times[kept], values[kept]


def fewer_knots(
    times: FloatArray, values: FloatArray, knots: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """Approximate a piecewise linear signal by fewer straight lines, with least squares.

    The mean over a few lines is then that of the signal, and so is its integral. If the error
    exceeds the tolerance, as at a jump, knots are added, at most all samples.

    Parameters
    ----------
    times, values : (n,)
        Samples of the signal.
    knots
        Increasing times of the first knots; times outside of the samples are left out.
    tolerance
        Tolerance over the range of the signal. A multiple of the signal's noise is added.

    Returns
    -------
    times, values
        Times and values of the knots.
    """
    if len(times) < 3 or not np.ptp(values) > 0.0:
        return times[[0, -1]], values[[0, -1]]
    limit = tolerance * float(np.ptp(values)) + NOISY * _noise(values)
    inside = knots[(knots > times[0]) & (knots < times[-1])]
    knots = np.unique(np.concatenate([times[:1], inside, times[-1:]]))
    fitted = _least_squares(times, values, knots)
    for _ in range(ROUNDS):
        off = np.abs(np.interp(times, knots, fitted) - values) > limit
        between = np.unique(np.clip(np.searchsorted(knots, times[off]) - 1, 0, len(knots) - 2))
        free = np.abs(fitted - np.interp(knots, times, values)) > limit
        after = np.searchsorted(times, knots[free])  # knots at samples nearby fix these values
        more = [_inner(times, values, knots, between), after, np.maximum(after - 1, 0)]
        denser = np.union1d(knots, times[np.concatenate(more)])
        if len(denser) == len(knots):
            break
        knots = denser
        fitted = _least_squares(times, values, knots)
    return knots, fitted


def _inner(times: FloatArray, values: FloatArray, knots: FloatArray, which: IntArray) -> IntArray:
    """Return samples that divide intervals between knots: both ends of a jump, or the middle."""
    first = np.searchsorted(times, knots[which])
    last = np.searchsorted(times, knots[which + 1], side="right") - 1
    found = [(first + last) // 2]
    for low, high in zip(first.tolist(), last.tolist(), strict=True):
        steps = np.abs(np.diff(values[max(low - 1, 0) : high + 2]))
        if len(steps) and steps.max() > 0.5 * steps.sum():
            jump = max(low - 1, 0) + int(np.argmax(steps))
            found.append(np.array([jump, jump + 1]))
    return np.asarray(np.clip(np.concatenate(found), 0, len(times) - 1))


def _noise(values: FloatArray) -> float:
    """Return the standard deviation of the noise, from fourth differences."""
    if len(values) < 6:
        return 0.0
    return float(np.median(np.abs(np.diff(values, 4))) / 0.6745 / np.sqrt(70.0))


def _least_squares(times: FloatArray, values: FloatArray, knots: FloatArray) -> FloatArray:
    """Return the values at knots of the piecewise linear least-squares fit to the samples."""
    place = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    right = (times - knots[place]) / (knots[place + 1] - knots[place])
    left, count = 1.0 - right, len(knots)

    def summed(weights: FloatArray, at: IntArray) -> FloatArray:
        return np.asarray(np.bincount(at, weights, count), np.float64)

    bands = np.zeros((2, count))
    bands[1] = HELD_FAST + summed(left**2, place) + summed(right**2, place + 1)
    bands[0, 1:] = summed(left * right, place)[:-1]
    target = summed(left * values, place) + summed(right * values, place + 1)
    target += HELD_FAST * np.interp(knots, times, values)
    return np.asarray(solveh_banded(bands, target))
