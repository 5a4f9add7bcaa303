"""Second derivatives that a sequential method knows without asking for them.

Two guesses of the Hessian of the Lagrangian compete. Gauss-Newton's matrix of the cost, 2 J'WJ, is
right where residuals are small and constraints straight. A quasi-Newton matrix is that one, or a
multiple of the identity where there is none, updated by the change of the gradient along each of
the last steps: it learns what large residuals and bent constraints add. Whichever foretold the last
steps better makes the next one, as in J. E. Dennis, D. M. Gay, R. E. Welsch, ACM TOMS 7 (1981)
348-368, doi:10.1145/355958.355965.

Updates are those of Broyden, Fletcher, Goldfarb and Shanno, damped so that the matrix stays
positive definite (J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed. (2006), procedure 18.2,
doi:10.1007/978-0-387-40065-5).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from cluster_est.methods.derivatives.gradients import CostDerivatives
from workers.messages import FloatArray

Hessian = Literal["auto", "gauss_newton", "quasi_newton"]
MEMORY = 30
"""Steps that are remembered."""
FORGETTING = 0.5
"""How much of the older errors still counts at each step."""
RIDGE = 1e-12


class CurvatureHistory:
    """Collects what is known of the curvature, iteration after iteration."""

    def __init__(self, kind: Hessian) -> None:
        self._kind = kind
        self._known: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._errors = np.zeros(2)
        self._matrices: list[FloatArray] = []

    @property
    def matrix(self) -> FloatArray:
        """The better guess at the last point: positive semidefinite, (n, n)."""
        return self._matrices[self._better]

    @property
    def _better(self) -> int:
        return int(len(self._matrices) > 1 and self._errors[1] < self._errors[0])

    def at(
        self, x: FloatArray, slopes: CostDerivatives, multipliers: FloatArray, sizes: FloatArray
    ) -> None:
        """Move on to a point.

        Parameters
        ----------
        x, slopes
            The point and its derivatives.
        multipliers : (constraints,)
            Of the Lagrangian, as far as they are known.
        sizes : (n,)
            What a noticeable change of each unknown is.
        """
        self._known.append((x, slopes.gradient, slopes.constraints))
        self._known = self._known[-MEMORY - 1 :]
        pairs = self._pairs(multipliers)
        gauss_newton = slopes.curvature
        if gauss_newton is None:
            self._matrices = [_updated(_identity(pairs, slopes.gradient, sizes), pairs)]
            return
        scale = np.trace(gauss_newton * np.outer(sizes, sizes))
        gauss_newton = gauss_newton + np.diag(RIDGE * max(float(scale), 1e-300) / sizes**2)
        both = [gauss_newton, _updated(gauss_newton, pairs)]
        chosen = {"auto": both, "gauss_newton": both[:1], "quasi_newton": both[1:]}
        self._matrices = chosen[self._kind]

    def learn(self, step: FloatArray, linear: float, actual: float) -> None:
        """Compare both guesses with what a step did.

        Parameters
        ----------
        step : (n,)
            From the last point.
        linear, actual
            What the gradient alone foretold that it adds to the Lagrangian, and what it added.
        """
        if len(self._matrices) < 2 or not np.isfinite(actual):
            return
        foretold = [linear + 0.5 * float(step @ (matrix @ step)) for matrix in self._matrices]
        errors = np.abs(np.array(foretold) - actual)
        total = max(float(errors[0] + errors[1]), 1e-300)
        self._errors = FORGETTING * self._errors + errors / total

    def _pairs(self, multipliers: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Steps, and what they changed in the gradient of the Lagrangian."""
        pairs = []
        for before, after in zip(self._known[:-1], self._known[1:], strict=True):
            change = after[1] - before[1] + (after[2] - before[2]).T @ multipliers
            pairs.append((after[0] - before[0], change))
        return pairs


def _identity(
    pairs: list[tuple[FloatArray, FloatArray]], gradient: FloatArray, sizes: FloatArray
) -> FloatArray:
    """A multiple of the identity in units of `sizes`, as bent as the last step found the cost."""
    bend = max(float(np.abs(sizes * gradient).max(initial=0.0)), 1e-300)
    if pairs:
        step, change = pairs[-1][0] / sizes, pairs[-1][1] * sizes
        if step @ change > 0.0:
            bend = float(change @ change / (step @ change))
    return np.diag(bend / sizes**2)


def _updated(matrix: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Damped updates, from the oldest step to the latest."""
    for step, change in pairs:
        image = matrix @ step
        old, new = float(step @ image), float(step @ change)
        if not old > 0.0:
            continue
        if new < 0.2 * old:
            part = 0.8 * old / (old - new)
            change = part * change + (1.0 - part) * image
        matrix = matrix - np.outer(image, image) / old
        matrix = matrix + np.outer(change, change) / float(step @ change)
    return 0.5 * (matrix + matrix.T)
