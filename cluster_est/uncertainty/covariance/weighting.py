"""What the weights of a cost say about the scatter of the residuals.

A cost F has the gradient 2 J'psi with psi = w r (`Cost.weights`), so the covariance of its minimum
is that of an M-estimator, A^-1 B A^-1 with A = J' diag(psi') J and B = J' diag(psi^2) J: P. J.
Huber, Robust Statistics (1981), doi:10.1002/0471725250, section 7.6.

Two forms of it are used:

- Weights that are the same for all residuals of an output in an experiment are taken for what they
  stand for, 1 / sigma^2. Then psi' = w, and with s^2 = r'Wr / (n - k) the covariance is
  s^2 (J'WJ)^-1, the usual one. So it is for the sum of squares, and for the Gaussian likelihood
  with estimated sigmas, where s^2 comes out near 1.
- Weights that differ from residual to residual are those of a robust cost. A large residual has a
  small weight because it is large, not because it was measured less well, and the usual form would
  be too narrow. psi' and psi^2 are then averaged over the residuals of each output, with Huber's
  correction 1 + (k / n) var(psi') / mean(psi')^2 for few residuals: the sandwich under the
  assumption that all residuals of an output scatter alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray

ALIKE = 1e-9
SHIFT = 1e-4
"""Of the median residual, to differentiate psi."""


@dataclass(frozen=True)
class ResidualScatter:
    """How the residuals scatter, k directions having been fitted.

    The covariance is `variance` times that of the factors with `spread`.

    Attributes
    ----------
    variance
        s^2. A rise of the cost is to be compared with it too.
    degrees
        n - k.
    spread : (residuals,) or None
        None for 1 everywhere.
    """

    variance: float
    degrees: int
    spread: FloatArray | None


@dataclass(frozen=True)
class RowWeighting:
    """Row weights of the Jacobian at a solution.

    Attributes
    ----------
    factor : (residuals,)
        What each row of the Jacobian is multiplied with: sqrt(w), or the root of the mean psi'.
    robust
        Whether the weights are those of a robust cost.
    problem
        Why there is no covariance, if there is none.
    squares, slopes, groups : (residuals,)
        w r^2; of a robust cost psi^2, psi' and which output each residual is of.
    """

    factor: FloatArray
    robust: bool = False
    problem: str = ""
    squares: FloatArray | None = None
    slopes: FloatArray | None = None
    groups: IntArray | None = None

    def scatter(self, rank: int) -> ResidualScatter:
        """Of the residuals, once it is known how many directions were fitted."""
        count = len(self.factor)
        degrees = count - rank
        squares = self.squares
        if self.problem or degrees <= 0 or squares is None:
            return ResidualScatter(np.nan, degrees, None)
        if self.groups is None or self.slopes is None:
            return ResidualScatter(float(np.add.reduce(squares)) / degrees, degrees, None)
        spread = np.empty(count)
        for group in np.unique(self.groups):
            inside = self.groups == group
            slopes = self.slopes[inside]
            correction = 1.0 + rank / count * float(slopes.var()) / float(slopes.mean()) ** 2
            scale = float(squares[inside].mean()) * count / degrees
            spread[inside] = correction**2 * scale / float(slopes.mean())
        mean = float(spread.mean())
        alike = np.ptp(spread) <= ALIKE * mean
        return ResidualScatter(mean, degrees, None if alike else spread / mean)


def weigh(
    cost: Cost, residuals: FloatArray, outputs: IntArray, rows: Sequence[slice]
) -> RowWeighting:
    """Row weights at a solution.

    Parameters
    ----------
    cost
        What was minimised.
    residuals, outputs
        At the solution, and which output each is of; no outputs where nobody knows.
    rows
        Where each experiment's residuals stand.
    """
    count = len(residuals)
    weights = cost.weights(residuals, outputs)
    if weights is None or not np.isfinite(weights).all():
        return RowWeighting(np.ones(count), problem=f"the cost {cost.name!r} has no weights")
    groups = outputs if len(outputs) == count else np.zeros(count, np.int64)
    if _alike(weights, groups, rows):
        return RowWeighting(np.sqrt(weights), squares=weights * residuals**2)
    slopes = _slopes(cost, residuals, outputs)
    means = np.empty(count)
    for group in np.unique(groups):
        means[groups == group] = slopes[groups == group].mean()
    if not (means > 0.0).all():
        reason = "most residuals are outliers to the cost, whose scale is too small"
        return RowWeighting(np.ones(count), True, problem=reason)
    psi = weights * residuals
    return RowWeighting(np.sqrt(means), True, "", psi**2, slopes, groups)


def _alike(weights: FloatArray, groups: IntArray, rows: Sequence[slice]) -> bool:
    """Whether the weights are the same within each output of each experiment."""
    for row in rows:
        for group in np.unique(groups[row]):
            inside = weights[row][groups[row] == group]
            if np.ptp(inside) > ALIKE * inside.max():
                return False
    return True


def _slopes(cost: Cost, residuals: FloatArray, outputs: IntArray) -> FloatArray:
    """d psi / d r, by central differences.

    Every second residual is moved the other way, so that a scale that the cost takes from the
    residuals stays what it is.
    """
    shift = SHIFT * (float(np.median(np.abs(residuals))) or 1.0)
    signs = np.where(np.arange(len(residuals)) % 2 == 0, shift, -shift)
    high, low = residuals + signs, residuals - signs
    ahead, behind = cost.weights(high, outputs), cost.weights(low, outputs)
    if ahead is None or behind is None:
        return np.full(len(residuals), np.nan)
    return (ahead * high - behind * low) / (high - low)
