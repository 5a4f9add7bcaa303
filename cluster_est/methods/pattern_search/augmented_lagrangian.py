"""An augmented Lagrangian of a cost and its constraints.

For constraints c <= 0 or c = 0, multipliers m and a penalty p, the augmented Lagrangian is

    F + sum(t^2 - m^2) / (2 p),    t = m + p c for an equality, max(0, m + p c) for an inequality,

With correct multipliers and a finite penalty, its minimum is the minimum of the constrained
problem. The multipliers converge if each minimisation is followed by the update m = t:
R. M. Lewis, V. Torczon, A globally convergent augmented Lagrangian pattern search algorithm, SIAM
J. Optim. 12 (2002) 1075-1089, doi:10.1137/S1052623498339727.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.method import TOLERANCE
from workers.messages import FloatArray

INEQUALITY_MARGIN = 0.5 * TOLERANCE
"""Amount by which inequalities are tightened, because iterates approach minima from outside."""
NEGLIGIBLE_VIOLATION = 0.5 * TOLERANCE
LARGEST_REMAINDER = 0.25
"""Part of the error that may remain after a minimisation; otherwise the penalty grows."""
PENALTY_FACTOR = 8.0
FIRST_PENALTY = 30.0


@dataclass(frozen=True)
class AugmentedLagrangian:
    """An augmented Lagrangian.

    Attributes
    ----------
    equality : (constraints,)
        True for constraints that must be 0.
    margins : (constraints,)
        Amounts by which inequalities are tightened.
    multipliers : (constraints,)
        Multipliers, in units of the cost.
    penalty
        Penalty, in units of the cost.
    error
        Error of constraints and multipliers at the last update, see `constraint_error`.
    """

    equality: npt.NDArray[np.bool_]
    margins: FloatArray
    multipliers: FloatArray
    penalty: float
    error: float = np.inf

    def shifted(self, constraints: FloatArray) -> FloatArray:
        """Return t, the multipliers after an update at these constraints."""
        found = self.multipliers + self.penalty * (constraints + self.margins)
        return np.where(self.equality, found, np.maximum(found, 0.0))

    def values(self, costs: FloatArray, constraints: FloatArray) -> FloatArray:
        """Return values (points,) from costs (points,) and constraints (points, constraints)."""
        if not len(self.equality):
            return costs
        with np.errstate(over="ignore", invalid="ignore"):
            squares = self.shifted(constraints) ** 2 - self.multipliers**2
            found = costs + np.add.reduce(squares, axis=-1) / (2.0 * self.penalty)
        return np.where(np.isnan(found), np.inf, found)

    def constraint_error(self, constraints: FloatArray) -> float:
        """Return the largest |t - m| / p: a violation, or the slack if m is not 0."""
        change = np.abs(self.shifted(constraints) - self.multipliers)
        return float(change.max(initial=0.0)) / self.penalty

    def updated(self, constraints: FloatArray) -> AugmentedLagrangian:
        """Return it with the multipliers t; increase the penalty if the error hardly decreased."""
        error = self.constraint_error(constraints)
        new = replace(self, multipliers=self.shifted(constraints), error=error)
        return (
            new.stronger()
            if error > max(NEGLIGIBLE_VIOLATION, LARGEST_REMAINDER * self.error)
            else new
        )

    def stronger(self) -> AugmentedLagrangian:
        """Return it with a larger penalty."""
        return replace(self, penalty=PENALTY_FACTOR * self.penalty)


def first_lagrangian(equality: npt.NDArray[np.bool_], on_parameters: int) -> AugmentedLagrangian:
    """Return an augmented Lagrangian with multipliers 0 and a preliminary penalty of 1.

    Parameters
    ----------
    equality : (constraints,)
        True for constraints that must be 0.
    on_parameters
        Number of constraints on parameters, which come first and have no margin.
    """
    margins = np.where(equality, 0.0, INEQUALITY_MARGIN)
    margins[:on_parameters] = 0.0
    return AugmentedLagrangian(equality, margins, np.zeros(len(equality)), 1.0)


def first_penalty(costs: FloatArray, constraints: FloatArray) -> float:
    """Return a penalty from the differences of costs and constraints from the first point's.

    Parameters
    ----------
    costs : (points,)
        Finite costs.
    constraints : (points, constraints)
        Finite values of the constraints.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        cost_change = float(np.median(np.abs(costs[1:] - costs[0]))) if len(costs) > 1 else 0.0
        change = np.abs(constraints[1:] - constraints[0]).max(axis=1, initial=0.0)
        distance = float(np.mean(change)) if len(change) else 0.0
    cost_change = cost_change or abs(float(costs[0])) or 1.0
    return FIRST_PENALTY * cost_change / (distance or 1.0) ** 2
