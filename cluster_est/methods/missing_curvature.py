"""What the Gauss-Newton matrix lacks of the Hessian, from the gradients of two points.

The constraints of a minimum bend, and so do residuals that do not vanish; J'J knows of neither, and
its steps overshoot along a curved constraint. The missing part S is updated such that it explains
the last change of the gradient: J. E. Dennis, D. M. Gay, R. E. Welsch, An adaptive nonlinear
least-squares algorithm, ACM TOMS 7 (1981) 348-368, doi:10.1145/355958.355965.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray

SAFE = 1e-8
"""Least cosine between a step and the change of the gradient that an update trusts."""


@dataclass(frozen=True)
class MissingCurvature:
    """S, and the point at which it was updated.

    Attributes
    ----------
    matrix : (unknowns, unknowns)
        S, in units of the cost over those of the unknowns.
    x, gradient : (unknowns,)
        The point and the gradient of the cost there.
    slopes : (constraints, unknowns)
        Derivatives of the constraints there.
    multipliers : (constraints,)
        Theirs.
    """

    matrix: FloatArray = field(repr=False)
    x: FloatArray
    gradient: FloatArray
    slopes: FloatArray = field(repr=False)
    multipliers: FloatArray

    def updated(
        self, x: FloatArray, gradient: FloatArray, slopes: FloatArray, known: FloatArray
    ) -> FloatArray:
        """S at another point, where the Gauss-Newton matrix is `known`."""
        step = x - self.x
        change = gradient - self.gradient + (slopes - self.slopes).T @ self.multipliers
        missing = change - known @ step
        along = float(change @ step)
        if not along > SAFE * float(np.linalg.norm(change) * np.linalg.norm(step)):
            return self.matrix
        own = float(step @ (self.matrix @ step))
        sizing = min(1.0, abs(float(step @ missing) / own)) if own != 0.0 else 1.0
        matrix = sizing * self.matrix
        rest = missing - matrix @ step
        matrix = matrix + (np.outer(rest, change) + np.outer(change, rest)) / along
        return matrix - float(rest @ step) * np.outer(change, change) / along**2


def positive_root(matrix: FloatArray) -> FloatArray:
    """R with R'R the part of a symmetric matrix with positive eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
