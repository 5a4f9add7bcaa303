"""Approximations of the Hessian of the Lagrangian that need no further evaluations.

Two approximations compete. Gauss-Newton's matrix of the cost, 2 J'WJ, is
right where residuals are small and constraints straight. A quasi-Newton matrix is that one, or a
multiple of the identity where there is none, updated by the change of the gradient along each of
the last steps: it takes up what large residuals and curved constraints add. Whichever predicted the
last steps better makes the next one, as in J. E. Dennis, D. M. Gay, R. E. Welsch, ACM TOMS 7 (1981)
348-368, doi:10.1145/355958.355965.

Updates are those of Broyden, Fletcher, Goldfarb and Shanno, damped so that the matrix stays
positive definite (J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed. (2006), procedure 18.2,
doi:10.1007/978-0-387-40065-5). The symbols are theirs: B the matrix, s a step, y the change of the
Lagrangian's gradient along it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np

from cluster_est.methods.derivatives.gradients import CostDerivatives
from workers.messages import FloatArray

Hessian = Literal["auto", "gauss_newton", "quasi_newton"]
MEMORY = 30
"""Steps that the updates are made of."""
ERROR_DECAY = 0.5
"""Factor of the older prediction errors at each step."""
RIDGE = 1e-12


class HessianApproximations:
    """Two approximations of the Hessian, updated at each iterate, and their prediction errors."""

    def __init__(self, kind: Hessian) -> None:
        self._kind = kind
        self._iterates: list[tuple[FloatArray, CostDerivatives]] = []
        self._errors = np.zeros(2)
        self._matrices: list[FloatArray] = []

    @property
    def matrix(self) -> FloatArray:
        """The better approximation at the last point: positive semidefinite, (n, n)."""
        return self._matrices[self._better]

    @property
    def _better(self) -> int:
        return int(len(self._matrices) > 1 and self._errors[1] < self._errors[0])

    def update(
        self,
        x: FloatArray,
        derivatives: CostDerivatives,
        multipliers: FloatArray,
        sizes: FloatArray,
    ) -> None:
        """Add an iterate.

        Parameters
        ----------
        x, derivatives
            The point and its derivatives.
        multipliers : (constraints,)
            Of the Lagrangian, as far as they are known.
        sizes : (n,)
            A noticeable change of each unknown.
        """
        self._iterates.append((x, derivatives))
        self._iterates = self._iterates[-MEMORY - 1 :]
        pairs = self._pairs(multipliers)
        gauss_newton = derivatives.gauss_newton
        if gauss_newton is None:
            self._matrices = [_bfgs(_scaled_identity(pairs, derivatives.gradient, sizes), pairs)]
            return
        scale = np.trace(gauss_newton * np.outer(sizes, sizes))
        gauss_newton = gauss_newton + np.diag(RIDGE * max(float(scale), 1e-300) / sizes**2)
        both = [gauss_newton, _bfgs(gauss_newton, pairs)]
        chosen = {"auto": both, "gauss_newton": both[:1], "quasi_newton": both[1:]}
        self._matrices = chosen[self._kind]

    def compare(self, step: FloatArray, linear: float, actual: float) -> None:
        """Compare the predictions of both approximations with the change along a step.

        Parameters
        ----------
        step : (n,)
            From the last point.
        linear, actual
            The change of the Lagrangian that its gradient alone predicts, and the actual one.
        """
        if len(self._matrices) < 2 or not np.isfinite(actual):
            return
        predicted = [linear + 0.5 * float(step @ (matrix @ step)) for matrix in self._matrices]
        errors = np.abs(np.array(predicted) - actual)
        total = max(float(errors[0] + errors[1]), 1e-300)
        self._errors = ERROR_DECAY * self._errors + errors / total

    def _pairs(self, multipliers: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return the steps s, and the changes y of the Lagrangian's gradient along them.

        A derivative that is known at one end alone has no change.
        """
        pairs = []
        for (x, before), (x_after, after) in pairwise(self._iterates):
            if (before.frozen != after.frozen).any():
                continue
            bent = after.constraint_jacobian - before.constraint_jacobian
            pairs.append((x_after - x, after.gradient - before.gradient + bent.T @ multipliers))
        return pairs


def _scaled_identity(
    pairs: list[tuple[FloatArray, FloatArray]], gradient: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Return the identity in units of `sizes`, times y'y / s'y of the last step."""
    curvature = max(float(np.abs(sizes * gradient).max(initial=0.0)), 1e-300)
    if pairs:
        s, y = pairs[-1][0] / sizes, pairs[-1][1] * sizes
        if s @ y > 0.0:
            curvature = float(y @ y / (s @ y))
    return np.diag(curvature / sizes**2)


def _bfgs(matrix: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return the matrix after damped updates, from the oldest step to the latest."""
    for s, y in pairs:
        b_s = matrix @ s
        s_b_s, s_y = float(s @ b_s), float(s @ y)
        if not s_b_s > 0.0:
            continue
        if s_y < 0.2 * s_b_s:
            theta = 0.8 * s_b_s / (s_b_s - s_y)
            y = theta * y + (1.0 - theta) * b_s
        matrix = matrix - np.outer(b_s, b_s) / s_b_s
        matrix = matrix + np.outer(y, y) / float(s @ y)
    return 0.5 * (matrix + matrix.T)
