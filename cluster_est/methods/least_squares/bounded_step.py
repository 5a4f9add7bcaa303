"""The damped Gauss-Newton step within bounds, for many damping factors from one factorisation.

Symbols: J the Jacobian, r the residuals, D the scaling, p the step, lambda the damping.
"""

from __future__ import annotations

import numpy as np

from workers.messages import FloatArray

LARGEST_RATIO = 1e10
"""Columns whose sizes differ by more than this are brought to one size before they are factored."""


class StepSolver:
    """Minimises |J p + r|^2 + lambda |D p|^2 subject to lower <= p <= upper.

    J is reduced to its triangular factor once, so each further damping factor costs a problem as
    small as the number of unknowns.

    Parameters
    ----------
    matrix : (residuals, unknowns)
        J.
    residuals : (residuals,)
        r.
    scale : (unknowns,)
        D, the diagonal.
    lower, upper : (unknowns,)
        Bounds of the step; 0 lies between them.
    """

    def __init__(
        self,
        matrix: FloatArray,
        residuals: FloatArray,
        scale: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
    ) -> None:
        self._units = _units(scale)
        joined = np.column_stack([matrix / self._units, residuals])
        self._triangle = np.asarray(np.linalg.qr(joined, mode="r"), np.float64)
        self._scale = scale / self._units
        self._lower, self._upper = lower * self._units, upper * self._units

    def step(self, damping: float) -> FloatArray:
        """Return the step for one lambda; it is zero for unknowns whose column is zero."""
        size = len(self._scale)
        factor, right = self._triangle[:, :size], -self._triangle[:, size]
        rows = len(factor)
        system, target = np.zeros((rows + size, size)), np.zeros(rows + size)
        system[:rows], target[:rows] = factor, right
        np.fill_diagonal(system[rows:], np.sqrt(damping) * self._scale)
        free = np.linalg.lstsq(system, target, rcond=None)[0]
        if (free >= self._lower).all() and (free <= self._upper).all():
            return np.asarray(free / self._units)
        from scipy.optimize import lsq_linear  # slow to import, and most steps meet no bound

        bounds = (self._lower, np.maximum(self._upper, np.nextafter(self._lower, np.inf)))
        solved = lsq_linear(system, target, bounds, method="bvls", tol=1e-14).x
        return np.asarray(np.clip(solved, self._lower, self._upper) / self._units)

    def predicted_cost(self, step: FloatArray) -> float:
        """Return |J p + r|^2, the cost that the linear model predicts after a step."""
        moved = np.ones(len(step) + 1)
        moved[:-1] = step * self._units
        values = self._triangle @ moved
        return float(values @ values)


def _units(scale: FloatArray) -> FloatArray:
    """Return powers of two that bring columns to one size, where sizes are far apart; else ones.

    Small columns would be lost in the rounding of large ones. Dividing by ones changes no bit.
    """
    if np.max(scale, initial=0.0) <= LARGEST_RATIO * np.min(scale, initial=np.inf):
        return np.ones_like(scale)
    return np.asarray(2.0 ** np.round(np.log2(scale)), np.float64)
