"""The minimum of a strictly convex quadratic function within bounds, from unbounded minima.

Unknowns that leave their bounds are fixed there, and fixed ones that the slope pulls back are
freed, all at once as long as that lessens their number, else one at a time, which ends after
finitely many rounds: J. J. Judice, F. M. Pires, Comput. Oper. Res. 21 (1994) 587-596,
doi:10.1016/0305-0548(94)90106-6. A round costs the same however many change their places, so it
suits problems of thousands of unknowns.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from workers.messages import FloatArray

ROUNDS = 60
"""After which the last minimum is moved into the bounds instead."""
PATIENCE = 5
"""Rounds without fewer wrong places, before places change one at a time."""
ROUNDING = 1e-14
"""Of the terms of a slope: less of it has no sign."""

Solve = Callable[[npt.NDArray[np.bool_], FloatArray], FloatArray]
Slope = Callable[[FloatArray], tuple[FloatArray, float]]


def within_bounds(
    solve: Solve, slope: Slope, lower: FloatArray, upper: FloatArray, rounds: int = ROUNDS
) -> FloatArray:
    """(unknowns,): the minimum within bounds.

    Parameters
    ----------
    solve
        Of which unknowns are fixed, and where: the minimum over the others.
    slope
        Of a point: the gradient there, in units in which curvatures are about 1, and how large its
        terms are.
    lower, upper : (unknowns,)
        They may be the same.
    """
    count = len(lower)
    pinned = upper <= lower
    sides = np.where(pinned, -1, 0)
    fewest, patience = count + 1, PATIENCE
    found = np.zeros(count)
    for _ in range(rounds):
        target = np.where(sides < 0, lower, upper)
        found = solve(sides != 0, np.where(sides != 0, target, 0.0))
        wanted = _places(found, sides, pinned, slope, lower, upper)
        wrong = np.flatnonzero(wanted != sides)
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), PATIENCE
        else:
            patience -= 1
        chosen = wrong if patience > 0 else wrong[-1:]
        sides[chosen] = wanted[chosen]
    return np.clip(found, lower, upper)


def _places(
    found: FloatArray,
    sides: npt.NDArray[np.int_],
    pinned: npt.NDArray[np.bool_],
    slope: Slope,
    lower: FloatArray,
    upper: FloatArray,
) -> npt.NDArray[np.int_]:
    """Where each unknown belongs, as a minimum tells: -1, 1 for its bounds, 0 for between them."""
    free = sides == 0
    wanted = np.where(free & (found < lower), -1, np.where(free & (found > upper), 1, sides))
    if (sides != 0).any():
        gradient, size = slope(found)
        pulled = sides * gradient > ROUNDING * size
        wanted = np.where(pulled & ~pinned, 0, wanted)
    return wanted
