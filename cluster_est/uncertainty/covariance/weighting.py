"""Row weights of the Jacobian and the scatter of the residuals, from the weights of a cost.

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
import numpy.typing as npt

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray

EQUAL = 1e-9
PSI_STEP = 1e-4
"""Of the median residual, to differentiate psi."""


@dataclass(frozen=True)
class ResidualScatter:
    """The scatter of the residuals after k directions were fitted.

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


LARGEST_WEIGHT = 1e200
"""Weights above it stand for an infinite one."""
EXACT = "nothing is left of the residuals of an output whose noise is taken from them"


@dataclass(frozen=True)
class RowWeighting:
    """Row weights of the Jacobian at a solution.

    Attributes
    ----------
    factor : (residuals,)
        Of each row of the Jacobian: sqrt(w), or the root of the mean psi'.
    robust
        True if the weights are those of a robust cost.
    problem
        The reason why there is no covariance; "" if there is one.
    squares, psi_derivatives, groups : (residuals,)
        w r^2; of a robust cost psi^2, psi' and the output of each residual.
    residuals : (residuals,)
        sqrt(w) r, or psi over `factor`: what J'J and the rows of J make the estimates' errors of.
    priors : (residuals,)
        Whether each is that of a prior, whose standard deviation is known: it scatters by 1, also
        where the measurements scatter by more than their sigmas. None where there are none.
    hidden
        Number of values below a detection limit, whose residuals have no scatter of their own: the
        noise is then taken for what it was said to be.
    """

    factor: FloatArray
    robust: bool = False
    problem: str = ""
    squares: FloatArray | None = None
    psi_derivatives: FloatArray | None = None
    groups: IntArray | None = None
    residuals: FloatArray | None = None
    priors: npt.NDArray[np.bool_] | None = None
    hidden: int = 0

    def scatter(self, rank: int) -> ResidualScatter:
        """Return the scatter of the residuals after `rank` directions were fitted."""
        count = len(self.factor)
        degrees = count - rank
        squares = self.squares
        if self.problem or degrees <= 0 or squares is None:
            return ResidualScatter(np.nan, degrees, None)
        if self.hidden:
            return ResidualScatter(1.0, degrees, None)
        if self.groups is None or self.psi_derivatives is None:
            variance = float(np.add.reduce(squares)) / degrees
            if self.priors is None or not variance > 0.0:
                return ResidualScatter(variance, degrees, None)
            return ResidualScatter(variance, degrees, np.where(self.priors, 1.0 / variance, 1.0))
        spread = np.empty(count)
        for group in np.unique(self.groups):
            inside = self.groups == group
            psi_d = self.psi_derivatives[inside]
            correction = 1.0 + rank / count * float(psi_d.var()) / float(psi_d.mean()) ** 2
            scale = float(squares[inside].mean()) * count / degrees
            spread[inside] = correction**2 * scale / float(psi_d.mean())
        mean = float(spread.mean())
        constant = np.ptp(spread) <= EQUAL * mean
        return ResidualScatter(mean, degrees, None if constant else spread / mean)


def row_weighting(
    cost: Cost, residuals: FloatArray, outputs: IntArray, rows: Sequence[slice]
) -> RowWeighting:
    """Return row weights at a solution.

    Parameters
    ----------
    cost
        The cost that was minimised.
    residuals, outputs
        At the solution, and the output of each; no outputs where they are not known.
    rows
        Of each experiment's residuals.
    """
    count = len(residuals)
    weights = cost.weights(residuals, outputs)
    if weights is None or not np.isfinite(weights).all():
        return RowWeighting(np.ones(count), problem=f"the cost {cost.name!r} has no weights")
    if weights.max(initial=0.0) > LARGEST_WEIGHT:
        return RowWeighting(np.ones(count), problem=EXACT)
    groups = outputs if len(outputs) == count else np.zeros(count, np.int64)
    if _constant_in_groups(weights, groups, rows):
        factor = np.sqrt(weights)
        return RowWeighting(factor, squares=weights * residuals**2, residuals=factor * residuals)
    psi_derivatives = _psi_derivatives(cost, residuals, outputs)
    means = np.empty(count)
    for group in np.unique(groups):
        means[groups == group] = psi_derivatives[groups == group].mean()
    if not (means > 0.0).all():
        reason = "most residuals are outliers to the cost, whose scale is too small"
        return RowWeighting(np.ones(count), True, problem=reason)
    psi = weights * residuals
    factor = np.sqrt(means)
    return RowWeighting(factor, True, "", psi**2, psi_derivatives, groups, psi / factor)


def _constant_in_groups(weights: FloatArray, groups: IntArray, rows: Sequence[slice]) -> bool:
    """Return whether the weights are the same within each output of each experiment."""
    for row in rows:
        for group in np.unique(groups[row]):
            inside = weights[row][groups[row] == group]
            if np.ptp(inside) > EQUAL * inside.max():
                return False
    return True


def _psi_derivatives(cost: Cost, residuals: FloatArray, outputs: IntArray) -> FloatArray:
    """Return d psi / d r, by central differences.

    Every second residual has a step of the other sign, so that a scale that the cost takes from the
    residuals stays what it is.
    """
    step = PSI_STEP * (float(np.median(np.abs(residuals))) or 1.0)
    steps = np.where(np.arange(len(residuals)) % 2 == 0, step, -step)
    r_plus, r_minus = residuals + steps, residuals - steps
    w_plus, w_minus = cost.weights(r_plus, outputs), cost.weights(r_minus, outputs)
    if w_plus is None or w_minus is None:
        return np.full(len(residuals), np.nan)
    return (w_plus * r_plus - w_minus * r_minus) / (r_plus - r_minus)
