"""Quadratic models of a cost and its constraints through points that were evaluated anyway.

Of all quadratics through too few points the one with the least second derivatives (in the
Frobenius norm) is taken: A. L. Custodio, H. Rocha, L. N. Vicente, Incorporating minimum Frobenius
norm models in direct search, Comput. Optim. Appl. 46 (2010) 265-278,
doi:10.1007/s10589-009-9283-0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.methods.pattern_search.augmented_lagrangian import AugmentedLagrangian
from workers.messages import FloatArray

CURVATURE_WEIGHT = 1e-5
"""Weight of second derivatives against errors at the points."""


def points_needed(size: int) -> int:
    """Return the number of points that determine a quadratic in `size` unknowns."""
    return (size + 1) * (size + 2) // 2


@dataclass(frozen=True)
class QuadraticModel:
    """Values v + g s + s H s / 2 of some functions, the cost first and then the constraints.

    Attributes
    ----------
    values : (functions,)
        v.
    gradients : (functions, unknowns)
        g.
    hessians : (functions, unknowns, unknowns)
        H.
    """

    values: FloatArray
    gradients: FloatArray
    hessians: FloatArray

    def predicted(self, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (steps,) costs and (steps, constraints) after some steps (steps, unknowns)."""
        h_s = np.einsum("qij,kj->kqi", self.hessians, steps)
        values = self.values + steps @ self.gradients.T + 0.5 * np.einsum("kqi,ki->kq", h_s, steps)
        return values[:, 0], values[:, 1:]

    def minimum(
        self, lagrangian: AugmentedLagrangian, lower: FloatArray, upper: FloatArray
    ) -> FloatArray:
        """Return the step s within bounds at which the model's augmented Lagrangian is least."""
        from scipy.optimize import minimize  # slow to import: only a search imports it

        start = float(lagrangian.values(self.values[0], self.values[1:]))
        gradient = self.gradients[0] + lagrangian.shifted(self.values[1:]) @ self.gradients[1:]
        scale = float(np.abs(gradient).max() + np.abs(self.hessians[0]).max()) or 1.0

        def merit(s: FloatArray) -> tuple[float, FloatArray]:
            h_s = self.hessians @ s
            values = self.values + self.gradients @ s + 0.5 * (h_s @ s)
            gradients = self.gradients + h_s
            constraints = values[1:]
            value = float(lagrangian.values(values[0], constraints)) - start
            gradient = gradients[0] + lagrangian.shifted(constraints) @ gradients[1:]
            return value / scale, gradient / scale

        found = minimize(
            merit,
            np.zeros(len(lower)),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack([lower, upper]),
            options={"ftol": 1e-15, "gtol": 1e-12, "maxiter": 200},
        )
        step: FloatArray = np.clip(found.x, lower, upper)
        return step


def fit_model(base: FloatArray, steps: FloatArray, changes: FloatArray) -> QuadraticModel:
    """Return the model that interpolates `base` and, as far as it can, the other points.

    Parameters
    ----------
    base : (functions,)
        Values at s = 0.
    steps : (points, unknowns)
        Of order 1.
    changes : (points, functions)
        Values there, less those at s = 0.
    """
    size = steps.shape[1]
    rows, columns = np.triu_indices(size)
    # a coefficient's square is its part of the Frobenius norm
    factors = np.where(rows == columns, 0.5, np.sqrt(0.5))
    design = np.concatenate([steps, steps[:, rows] * steps[:, columns] * factors], axis=1)
    # the error of a quadratic grows with the third power of the distance
    weights = 1.0 / np.maximum(1.0, np.abs(steps).max(axis=1)) ** 3
    penalty = np.zeros((len(rows), design.shape[1]))
    penalty[:, size:] = CURVATURE_WEIGHT * np.eye(len(rows))
    left = np.concatenate([design * weights[:, None], penalty])
    right = np.concatenate([changes * weights[:, None], np.zeros((len(rows), len(base)))])
    found = np.linalg.lstsq(left, right, rcond=1e-13)[0]
    hessians = np.zeros((len(base), size, size))
    coefficients = found[size:].T * np.where(rows == columns, 0.5, np.sqrt(0.5))
    hessians[:, rows, columns] += coefficients
    hessians[:, columns, rows] += coefficients
    return QuadraticModel(base, np.ascontiguousarray(found[:size].T), hessians)
