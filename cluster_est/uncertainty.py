"""Standard errors and intervals from the Jacobian at the solution.

With residuals r of n numbers and k free unknowns, the covariance is s^2 (J'J)^-1 with
s^2 = r'r / (n - k): G. A. F. Seber, C. J. Wild, Nonlinear Regression (1989),
doi:10.1002/0471725315, section 2.1. It is right where the residuals are independent and the model
is nearly linear over the interval; residuals that are not white make the intervals too narrow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from cluster_est.methods.base import Solution
from cluster_est.space import Space
from workers.messages import FloatArray

UNDETERMINED = 1e-12
"""Smallest singular value of the scaled Jacobian, over the largest, that still counts."""


@dataclass(frozen=True)
class Interval:
    """Of one unknown, in physical units; NaN where the data do not determine it."""

    std_error: float
    lower95: float
    upper95: float
    at_bound: str


def intervals(space: Space, solution: Solution) -> list[Interval]:
    """An interval for each unknown.

    Unknowns at a bound are held there; those that the data do not determine, alone or together
    with others, get NaN.
    """
    sides = [_side(space, solution.x, i) for i in range(space.size)]
    free = [i for i, side in enumerate(sides) if not side]
    errors = np.full(space.size, np.nan)
    degrees = (space.rows[-1].stop if space.rows else 0) - len(free)
    if solution.jacobian is not None and free and degrees > 0 and np.isfinite(solution.cost):
        variance = solution.cost / degrees
        errors[free] = np.sqrt(variance * _inverse_diagonal(solution.jacobian[:, free]))
    width = float(student.ppf(0.975, degrees)) if degrees > 0 else np.nan
    return [_interval(space, solution.x, i, errors[i], width, sides[i]) for i in range(space.size)]


def _inverse_diagonal(matrix: FloatArray) -> FloatArray:
    """Diagonal of (J'J)^-1; NaN for every unknown with a part in an undetermined direction."""
    norms = np.linalg.norm(matrix, axis=0)
    scale = np.where(norms > 0.0, norms, 1.0)
    _, singular, rows = np.linalg.svd(matrix / scale, full_matrices=False)
    lost = singular <= UNDETERMINED * singular[0]
    weak = (np.abs(rows[lost]) > 1e-6).any(axis=0) | (norms == 0.0)
    kept = rows[~lost] / singular[~lost, None]
    return np.where(weak, np.nan, (kept**2).sum(axis=0) / scale**2)


def _side(space: Space, x: FloatArray, i: int) -> str:
    """Which bound the unknown stands at, to within a millionth of its scale."""
    near = 1e-6 * space.typical[i]
    if x[i] - space.lower[i] <= near:
        return "lower"
    return "upper" if space.upper[i] - x[i] <= near else ""


def _interval(
    space: Space, x: FloatArray, i: int, error: float, width: float, side: str
) -> Interval:
    unknown = space.unknowns[i]
    low = unknown.to_physical(float(x[i] - width * error)) if np.isfinite(error) else np.nan
    high = unknown.to_physical(float(x[i] + width * error)) if np.isfinite(error) else np.nan
    physical = error * unknown.to_physical(float(x[i])) if unknown.log else error
    return Interval(float(physical), low, high, side)
