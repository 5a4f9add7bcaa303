"""One number of a cost and its constraints: an augmented Lagrangian.

For constraints c <= 0 or c = 0, multipliers m and a penalty p it is

    F + sum(t^2 - m^2) / (2 p),    t = m + p c for an equality, max(0, m + p c) for an inequality,

and its minimum is that of the constrained problem once the multipliers are right, with a penalty
that stays finite. Minimising it and then taking t for m makes them right: R. M. Lewis, V. Torczon,
A globally convergent augmented Lagrangian pattern search algorithm, SIAM J. Optim. 12 (2002)
1075-1089, doi:10.1137/S1052623498339727.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import TOLERANCE
from workers.messages import FloatArray

MARGIN = 0.5 * TOLERANCE
"""Inequalities are aimed at so far inside: their minima are approached from outside."""
CLOSE = 0.5 * TOLERANCE
ENOUGH = 0.25
"""Part of the gap that may remain after a minimisation, or the penalty grows."""
STRONGER = 8.0
FIRST_PENALTY = 30.0


@dataclass(frozen=True)
class AugmentedLagrangian:
    """An augmented Lagrangian.

    Attributes
    ----------
    equality : (constraints,)
        Which constraints must be 0.
    margins : (constraints,)
        How far inside the others are aimed at.
    multipliers : (constraints,)
        In units of the cost.
    penalty
        In units of the cost.
    gap
        What was missing when the multipliers were updated last.
    """

    equality: npt.NDArray[np.bool_]
    margins: FloatArray
    multipliers: FloatArray
    penalty: float
    gap: float = np.inf

    def shifted(self, constraints: FloatArray) -> FloatArray:
        """What the multipliers would be after an update at these constraints."""
        found = self.multipliers + self.penalty * (constraints + self.margins)
        return np.where(self.equality, found, np.maximum(found, 0.0))

    def values(self, costs: FloatArray, constraints: FloatArray) -> FloatArray:
        """(points,) of (points,) costs and (points, constraints); infinite where those are."""
        if not len(self.equality):
            return costs
        with np.errstate(over="ignore", invalid="ignore"):
            squares = self.shifted(constraints) ** 2 - self.multipliers**2
            found = costs + np.add.reduce(squares, axis=-1) / (2.0 * self.penalty)
        return np.where(np.isnan(found), np.inf, found)

    def missing(self, constraints: FloatArray) -> float:
        """How far a point is from satisfying the constraints, and with them as active as at it."""
        moved = np.abs(self.shifted(constraints) - self.multipliers)
        return float(moved.max(initial=0.0)) / self.penalty

    def updated(self, constraints: FloatArray) -> AugmentedLagrangian:
        """With the multipliers of a minimum; with more penalty if it came hardly closer."""
        gap = self.missing(constraints)
        new = replace(self, multipliers=self.shifted(constraints), gap=gap)
        return new.stronger() if gap > max(CLOSE, ENOUGH * self.gap) else new

    def stronger(self) -> AugmentedLagrangian:
        return replace(self, penalty=STRONGER * self.penalty)


def first_lagrangian(equality: npt.NDArray[np.bool_], on_parameters: int) -> AugmentedLagrangian:
    """Without multipliers, and with a penalty that means nothing yet.

    Parameters
    ----------
    equality : (constraints,)
        Which constraints must be 0.
    on_parameters
        How many of them, at the front, are kept by other means.
    """
    margins = np.where(equality, 0.0, MARGIN)
    margins[:on_parameters] = 0.0
    return AugmentedLagrangian(equality, margins, np.zeros(len(equality)), 1.0)


def first_penalty(costs: FloatArray, constraints: FloatArray) -> float:
    """A penalty that suits how much costs and constraints differ from those of the first point.

    Parameters
    ----------
    costs : (points,)
        Finite.
    constraints : (points, constraints)
        Finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        gain = float(np.median(np.abs(costs[1:] - costs[0]))) if len(costs) > 1 else 0.0
        change = np.abs(constraints[1:] - constraints[0]).max(axis=1, initial=0.0)
        far = float(np.mean(change)) if len(change) else 0.0
    gain = gain or abs(float(costs[0])) or 1.0
    return FIRST_PENALTY * gain / (far or 1.0) ** 2
