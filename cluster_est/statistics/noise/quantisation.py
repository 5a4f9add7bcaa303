"""The step of a quantised signal: of a converter, an encoder or a table of few digits."""

from __future__ import annotations

import numpy as np

from workers.messages import FloatArray

WHOLE = 0.01
"""Distance from a whole number, in steps, that the rounding of a table's digits may leave."""

AGREEING = 4
"""Gaps that must be whole steps where hardly a value repeats: those of values that were not rounded
all come so close to whole numbers with a probability of (2 * 0.01)^4, about 2e-7."""

REPEATED = 0.5
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
    whole = np.abs(steps - np.rint(steps)) <= WHOLE + 2.0 * rounding / step * steps
    repeats = 1.0 - len(levels) / len(values) >= REPEATED
    if not np.all(whole) or not (repeats or len(gaps) > AGREEING):
        return 0.0
    return step
