"""The damped Gauss-Newton step within bounds, for many damping factors from one factorisation."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from workers.messages import FloatArray


class StepSolver:
    """Minimises |J p + r|^2 + damping |D p|^2 subject to lower <= p <= upper.

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
        joined = np.column_stack([matrix, residuals])
        self._triangle = np.asarray(np.linalg.qr(joined, mode="r"), np.float64)
        self._scale, self._lower, self._upper = scale, lower, upper

    def step(self, damping: float) -> FloatArray:
        """The step for one damping factor; it is zero for unknowns whose column is zero."""
        size = len(self._scale)
        factor, right = self._triangle[:, :size], -self._triangle[:, size]
        system = np.vstack([factor, np.sqrt(damping) * np.diag(self._scale)])
        target = np.concatenate([right, np.zeros(size)])
        free = np.linalg.lstsq(system, target, rcond=None)[0]
        if (free >= self._lower).all() and (free <= self._upper).all():
            return np.asarray(free)
        bounds = (self._lower, np.maximum(self._upper, np.nextafter(self._lower, np.inf)))
        solved = lsq_linear(system, target, bounds, method="bvls", tol=1e-14).x
        return np.asarray(np.clip(solved, self._lower, self._upper))

    def predicted_cost(self, step: FloatArray) -> float:
        """|J p + r|^2, the cost that the linear model expects after a step."""
        values = self._triangle @ np.append(step, 1.0)
        return float(values @ values)
