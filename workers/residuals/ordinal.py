"""Outputs of which only the order of the measured values is known: optimal scaling.

Equal measured values are a category, and the categories stand in order. Category c holds the
simulated values between two bounds that are found with the residuals: with y_j for the simulated
values, s for their standard deviation and t_1, t_2, ... for the thresholds between neighbours,

    e_j = distance of y_j to [t_(c-1) + gap / 2, t_c - gap / 2], over sigma s,
    (t_1, t_2, ...) = argmin sum e_j^2   with   t_c + gap <= t_(c+1),   gap = s / (2 K),

K categories, open at both ends: R. N. Shepard, Psychometrika 27 (1962) 125-140,
doi:10.1007/BF02289630; for dynamic models L. Schmiester, D. Weindl, J. Hasenauer, J. Math. Biol. 81
(2020) 603-623, doi:10.1007/s00285-020-01522-w. Within a category no order is asked for, which is
the primary approach to ties of J. B. Kruskal, Psychometrika 29 (1964) 1-27, doi:10.1007/BF02289565.

Distances and gap are over the spread s, so that nothing is won by a simulation that is only
smaller: an order says nothing of scale and offset, and neither does e. Without the gap a simulation
that hardly moves but for one sample would fit any order.

The thresholds minimise a sum of convex functions, one of each, along a chain, which pooling
adjacent violators solves exactly: M. J. Best, N. Chakravarti, V. A. Ubhaya, SIAM J. Optim. 10
(2000) 658-672, doi:10.1137/S1052623497314970. Each function is a sum of squared hinges, so the
residuals are unique and continuous in y, their squares continuously differentiable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from workers.messages import FloatArray, IntArray

GAPS = 0.5
"""Of all gaps together, in spreads of the simulated signal. Wide gaps bias what is found where
samples lie densely around a threshold, which in truth has no gap; with narrow ones a simulation
whose samples nearly all coincide costs little."""
NO_MOTION = 1e-12
"""Spread over the largest value, up to which a simulation does not move."""
NOTHING_KNOWN = 1.0
"""The distance of every sample of a simulation that does not move, in spreads: it has no order,
which must not cost less than a wrong one."""


class CategoryBounds(NamedTuple):
    """Which simulated values each category holds.

    Attributes
    ----------
    categories : (K,)
        Measured values, each once, in order.
    lower, upper : (K,)
        Simulated values; infinite at the ends.
    spread
        Standard deviation of the simulated values; 0 if they do not move, NaN if they are not
        finite.
    """

    categories: FloatArray
    lower: FloatArray
    upper: FloatArray
    spread: float


def category_bounds(measured: FloatArray, simulated: FloatArray) -> CategoryBounds:
    """Return the bounds that suit simulated values best.

    Where several do as well, they are in the middle of those.

    Parameters
    ----------
    measured, simulated : (n,)
        At the same times; at least one.
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
    gap = GAPS / len(categories)
    places = (simulated - centre) / spread
    thresholds = centre + spread * _thresholds(places, numbers, len(categories), gap)
    half = 0.5 * gap * spread
    lower = np.concatenate([[-np.inf], thresholds + half])
    upper = np.concatenate([thresholds - half, [np.inf]])
    return CategoryBounds(categories, lower, upper, spread)


def disparities(bounds: CategoryBounds, measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """Return for each sample the value of its category that is nearest to the simulated one, (n,).

    A measured value that is none of the categories may lie anywhere between its neighbours' far
    ends. NaN where there are no bounds.
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
        return np.full(len(simulated), NOTHING_KNOWN / sigma)
    if not np.isfinite(bounds.spread):
        return np.full(len(simulated), np.nan)
    nearest = disparities(bounds, measured, simulated)
    return np.asarray((nearest - simulated) / bounds.spread / sigma)


def _thresholds(places: FloatArray, numbers: IntArray, count: int, gap: float) -> FloatArray:
    """Return the best thresholds (count - 1,), at least `gap` apart, of numbered categories.

    In tau_c = t_c - c gap the chain is tau_1 <= tau_2 <= ..., and the samples of category c should
    lie below tau_c + c gap - gap / 2, those of c + 1 above tau_c + c gap + gap / 2.
    """
    order = np.argsort(numbers, kind="stable")
    members = np.split(places[order], np.searchsorted(numbers[order], np.arange(1, count)))
    shifts = gap * np.arange(count - 1)
    below = [
        own + 0.5 * gap - shift for own, shift in zip(members[:-1], shifts.tolist(), strict=True)
    ]
    above = [
        own - 0.5 * gap - shift for own, shift in zip(members[1:], shifts.tolist(), strict=True)
    ]
    lowest, highest = (_pooled(below, above, largest) for largest in (False, True))
    return np.asarray(0.5 * (lowest + highest) + shifts)


def _pooled(below: list[FloatArray], above: list[FloatArray], largest: bool) -> FloatArray:
    """Pool adjacent violators: the smallest or the largest nondecreasing minimiser.

    `below` holds the samples that each threshold should be above, `above` those it should be below.
    """
    blocks: list[tuple[float, int, FloatArray, FloatArray]] = []
    for low, high in zip(below, above, strict=True):
        block = (_balance(low, high, largest), 1, low, high)
        while blocks and blocks[-1][0] > block[0]:
            _, width, more_low, more_high = blocks.pop()
            low, high = np.concatenate([more_low, block[2]]), np.concatenate([more_high, block[3]])
            block = (_balance(low, high, largest), width + block[1], low, high)
        blocks.append(block)
    return np.concatenate([np.zeros(0), *(np.full(width, tau) for tau, width, _, _ in blocks)])


def _balance(low: FloatArray, high: FloatArray, largest: bool) -> float:
    """Return the tau that minimises sum (low - tau)_+^2 + sum (tau - high)_+^2.

    Half its derivative is piecewise linear and rises from one sample to the next.
    """
    ends = float(low.max()), float(high.min())
    if ends[0] <= ends[1]:  # nothing is on the wrong side
        return ends[1] if largest else ends[0]
    low, high = np.sort(low[low > ends[1]]), np.sort(high[high < ends[0]])
    knots = np.sort(np.concatenate([low, high]))
    left = np.searchsorted(high, knots, side="right")  # those that tau is above
    right = np.searchsorted(low, knots, side="right")  # the first that it is below
    sums_high, sums_low = (np.concatenate([[0.0], np.cumsum(each)]) for each in (high, low))
    slopes = left + len(low) - right
    totals = sums_high[left] + (sums_low[-1] - sums_low[right])
    # the derivative at knot k is slopes[k] * knots[k] - totals[k], and so it is up to the next
    k = max(int(np.searchsorted(slopes * knots - totals > 0.0, True)) - 1, 0)
    return float(totals[k] / slopes[k]) if slopes[k] else float(knots[k])
