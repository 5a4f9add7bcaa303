"""Ordinal outputs, of which only the order of the measured values is known: optimal scaling.

Equal measured values form a category, and the categories are ordered. Category c contains the
simulated values between two bounds, which are estimated together with the residuals. With simulated
values y_j, their standard deviation s, and thresholds t_1, t_2, ... between neighbouring
categories,

    e_j = distance of y_j to [t_(c-1) + gap / 2, t_c - gap / 2], over sigma s,

    (t_1, t_2, ...) = argmin sum e_j^2   with   t_c + gap <= t_(c+1),   gap = s / (2 K),

for K categories, the outer ones unbounded: R. N. Shepard, Psychometrika 27 (1962) 125-140,
doi:10.1007/BF02289630; for dynamic models L. Schmiester, D. Weindl, J. Hasenauer, J. Math. Biol. 81
(2020) 603-623, doi:10.1007/s00285-020-01522-w. Within a category, any order is allowed. This is the
primary approach to ties of J. B. Kruskal, Psychometrika 29 (1964) 1-27, doi:10.1007/BF02289565.

Distances and gap are divided by s, so a simulation cannot reduce them merely by a smaller scale. An
order does not depend on scale and offset, and neither does e. Without the gap, a simulation that is
constant except for one sample would fit any order.

The thresholds minimise a sum of convex functions, one of each threshold, subject to a chain of
inequalities. Pooling adjacent violators solves this exactly: M. J. Best, N. Chakravarti, V. A.
Ubhaya, SIAM J. Optim. 10 (2000) 658-672, doi:10.1137/S1052623497314970. Each function is a sum of
squared hinges. So the residuals are unique and continuous in y, and their squares are continuously
differentiable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from workers.messages import FloatArray, IntArray

SUM_OF_GAPS = 0.5
"""Sum of all gaps, in units of the spread of the simulated signal. Wide gaps bias the estimates if
samples are dense around a threshold, which has no true gap. With narrow gaps, a simulation whose
samples nearly all coincide has a low cost."""
NO_MOTION = 1e-12
"""Largest ratio of the spread to the largest value at which a simulation counts as constant."""
DISTANCE_WITHOUT_ORDER = 1.0 + 0.5 * SUM_OF_GAPS
"""Distance of every sample of a constant simulation, in spreads. A constant simulation has no
order, and must not cost less than a wrong order. With all thresholds around its mean, any
simulation has a root mean square distance of at most this value."""


class CategoryBounds(NamedTuple):
    """Bounds of the simulated values of each category.

    Attributes
    ----------
    categories : (K,)
        Distinct measured values, in order.
    lower, upper : (K,)
        Bounds of simulated values; infinite at the ends.
    spread
        Standard deviation of the simulated values; 0 if they are constant, NaN if they are not
        finite.
    """

    categories: FloatArray
    lower: FloatArray
    upper: FloatArray
    spread: float


def category_bounds(measured: FloatArray, simulated: FloatArray) -> CategoryBounds:
    """Return the category bounds that fit simulated values best.

    If the minimum is not unique, they are in the middle of the set of minimisers.

    Parameters
    ----------
    measured, simulated : (n,)
        Values at the same times; at least one.
    """
    categories, numbers = np.unique(measured, return_inverse=True)
    none = np.full(len(categories), np.nan)
    if not np.isfinite(simulated).all():
        return CategoryBounds(categories, none, none, np.nan)
    size, count = float(np.abs(simulated).max()), len(simulated)
    with np.errstate(over="ignore", invalid="ignore"):
        centre = float(np.add.reduce(simulated)) / count
        spread = float(np.sqrt(np.add.reduce((simulated - centre) ** 2) / count))
    if not np.isfinite(spread):
        return CategoryBounds(categories, none, none, np.nan)
    if not spread > NO_MOTION * size:
        return CategoryBounds(categories, none, none, 0.0)
    gap = SUM_OF_GAPS / len(categories)
    places = (simulated - centre) / spread
    thresholds = centre + spread * _thresholds(places, numbers, len(categories), gap)
    half = 0.5 * gap * spread
    lower = np.concatenate([[-np.inf], thresholds + half])
    upper = np.concatenate([thresholds - half, [np.inf]])
    return CategoryBounds(categories, lower, upper, spread)


def disparities(bounds: CategoryBounds, measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """Return the value in each sample's category that is nearest to the simulated value, (n,).

    For a measured value that is not a category, the interval includes both neighbouring categories.
    The result is NaN if there are no bounds.
    """
    last = len(bounds.categories) - 1
    below = np.searchsorted(bounds.categories, measured, side="right") - 1
    above = np.searchsorted(bounds.categories, measured, side="left")
    lower = np.where(below >= 0, bounds.lower[np.maximum(below, 0)], -np.inf)
    upper = np.where(above <= last, bounds.upper[np.minimum(above, last)], np.inf)
    return np.asarray(np.minimum(np.maximum(simulated, lower), upper))


def ordinal_residuals(
    bounds: CategoryBounds, measured: FloatArray, simulated: FloatArray, sigma: float
) -> FloatArray:
    """Return the signed distances of simulated values to their categories, over sigma spreads."""
    if bounds.spread == 0.0:
        return np.full(len(simulated), DISTANCE_WITHOUT_ORDER / sigma)
    if not np.isfinite(bounds.spread):
        return np.full(len(simulated), np.nan)
    nearest = disparities(bounds, measured, simulated)
    return np.asarray((nearest - simulated) / bounds.spread / sigma)


def _thresholds(places: FloatArray, numbers: IntArray, count: int, gap: float) -> FloatArray:
    """Return the best thresholds (count - 1,), at least `gap` apart, of numbered categories.

    With tau_c = t_c - c gap, the chain is tau_1 <= tau_2 <= .... Samples of category c should be
    below tau_c + c gap - gap / 2, and samples of category c + 1 above tau_c + c gap + gap / 2.
    """
    last = count - 1
    below, above = numbers < last, numbers > 0
    low = _SidedSamples(places[below] + gap * (0.5 - numbers[below]), numbers[below])
    high = _SidedSamples(places[above] + gap * (0.5 - numbers[above]), numbers[above] - 1)
    largest = _pooled(low, high, last)
    smallest = -_pooled(high.mirrored(last), low.mirrored(last), last)[::-1]
    return np.asarray(0.5 * (smallest + largest) + gap * np.arange(last))


class _SidedSamples(NamedTuple):
    """Samples that should be on one side of a threshold: their positions and thresholds."""

    places: FloatArray
    thresholds: IntArray

    def mirrored(self, count: int) -> _SidedSamples:
        return _SidedSamples(-self.places, count - 1 - self.thresholds)


def _pooled(low: _SidedSamples, high: _SidedSamples, count: int) -> FloatArray:
    """Return the largest nondecreasing minimiser (count,), by pooling adjacent violators.

    All adjacent violators are pooled at once; the order of pooling does not matter.

    Parameters
    ----------
    low, high
        Samples that should be below, and above, each threshold; each threshold has both.
    """
    blocks = np.arange(count)
    while True:
        found = _minimisers(low, high, blocks)
        rises = found[1:] >= found[:-1]
        if rises.all():
            return np.asarray(found[blocks])
        blocks = np.concatenate([[0], np.cumsum(rises)])[blocks]


def _minimisers(low: _SidedSamples, high: _SidedSamples, blocks: IntArray) -> FloatArray:
    """Return for each block the largest tau that minimises the squares of the violations.

    Half the derivative of sum (low - tau)_+^2 + sum (tau - high)_+^2 is piecewise linear and
    increases from sample to sample; its slope is the number of samples beyond tau. `blocks`
    (thresholds,) contains the block of each threshold.
    """
    block = np.concatenate([blocks[low.thresholds], blocks[high.thresholds]])
    knots = np.concatenate([low.places, high.places])
    order = np.lexsort((knots, block))
    knots, block, is_high = knots[order], block[order], order >= len(low.places)
    firsts = np.flatnonzero(np.diff(block, prepend=-1))
    lows, highs = np.where(is_high, 0.0, knots), np.where(is_high, knots, 0.0)
    is_low, above = (~is_high).astype(np.float64), is_high.astype(np.float64)
    passed = _counted_from(firsts, block, above)
    waiting = np.add.reduceat(is_low, firsts)[block] - _counted_from(firsts, block, is_low)
    totals = _counted_from(firsts, block, highs)
    totals += np.add.reduceat(lows, firsts)[block] - _counted_from(firsts, block, lows)
    slopes = passed + waiting
    falls = slopes * knots <= totals
    falls[firsts] = True  # below all samples, except for rounding
    k = np.maximum.reduceat(np.where(falls, np.arange(len(knots)), 0), firsts)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = totals[k] / slopes[k]
    lowest = np.minimum.reduceat(np.where(is_high, knots, np.inf), firsts)
    highest = np.maximum.reduceat(np.where(is_high, -np.inf, knots), firsts)
    # no sample is beyond any tau between the two
    return np.asarray(np.where(highest <= lowest, lowest, found))


def _counted_from(firsts: IntArray, block: IntArray, values: FloatArray) -> FloatArray:
    """Return cumulative sums that restart with each block."""
    sums = np.cumsum(values)
    return np.asarray(sums - (sums[firsts] - values[firsts])[block])
