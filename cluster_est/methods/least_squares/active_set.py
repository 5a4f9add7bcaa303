"""The minimum of a strictly convex quadratic function within bounds, from unbounded minima.

Unknowns that leave their bounds are fixed there, and fixed ones whose multiplier has the wrong sign
are freed, all at once as long as that lessens their number, else one at a time, which ends after
finitely many rounds (block principal pivoting): J. J. Judice, F. M. Pires, Comput. Oper. Res. 21
(1994) 587-596, doi:10.1016/0305-0548(94)90106-6. A round costs the same however many unknowns
change, so it suits problems of thousands of unknowns.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from workers.messages import FloatArray

ROUNDS = 60
"""After which the last minimum is moved into the bounds instead."""
PATIENCE = 5
"""Rounds without fewer infeasibilities, before one unknown changes at a time."""
ROUNDING = 1e-14
"""Of the terms of a gradient: less of it has no sign."""

Solve = Callable[[npt.NDArray[np.bool_], FloatArray], FloatArray]
Gradient = Callable[[FloatArray], tuple[FloatArray, float]]


def within_bounds(
    solve: Solve, gradient: Gradient, lower: FloatArray, upper: FloatArray, rounds: int = ROUNDS
) -> FloatArray:
    """Return the minimum (unknowns,) within bounds.

    Parameters
    ----------
    solve
        From a mask of the fixed unknowns and their values: the minimum over the others.
    gradient
        From a point: the gradient there, in units in which curvatures are about 1, and the size of
        its terms.
    lower, upper : (unknowns,)
        They may be the same.
    """
    count = len(lower)
    equal = upper <= lower
    active = np.where(equal, -1, 0)  # -1 and 1 for the bounds, 0 for between them
    fewest, patience = count + 1, PATIENCE
    x = np.zeros(count)
    for _ in range(rounds):
        bound = np.where(active < 0, lower, upper)
        x = solve(active != 0, np.where(active != 0, bound, 0.0))
        wanted = np.where(active == 0, np.where(x < lower, -1, np.where(x > upper, 1, 0)), active)
        if (active != 0).any():
            g, size = gradient(x)
            wanted = np.where((active * g > ROUNDING * size) & ~equal, 0, wanted)
        infeasible = np.flatnonzero(wanted != active)
        if not len(infeasible):
            break
        if len(infeasible) < fewest:
            fewest, patience = len(infeasible), PATIENCE
        else:
            patience -= 1
        changed = infeasible if patience > 0 else infeasible[-1:]
        active[changed] = wanted[changed]
    return np.clip(x, lower, upper)
