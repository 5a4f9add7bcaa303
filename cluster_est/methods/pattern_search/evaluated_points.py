"""All points that a pattern search has evaluated, with their costs and constraints."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import Evaluation
from workers.messages import FloatArray, IntArray

ROUNDING = 2.0**-40
"""Points that agree to this, in units of a noticeable change, are the same."""


class EvaluatedPoints:
    """Points in the coordinates of a `ScaledCoordinates`, numbered in the order in which they came.

    Parameters
    ----------
    size
        Number of unknowns.
    constraints
        Number of constraints.
    """

    def __init__(self, size: int, constraints: int) -> None:
        self._points = np.empty((64, size))
        self._costs = np.empty(64)
        self._constraints = np.empty((64, constraints))
        self._numbers: dict[bytes, int] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def points(self) -> FloatArray:
        return self._points[: self._count]

    @property
    def costs(self) -> FloatArray:
        """(points,); infinite where a simulation failed."""
        return self._costs[: self._count]

    @property
    def constraints(self) -> FloatArray:
        """(points, constraints); infinite where one has no value."""
        return self._constraints[: self._count]

    def __contains__(self, u: FloatArray) -> bool:
        return key(u) in self._numbers

    def add(self, u: FloatArray, evaluation: Evaluation) -> int:
        """Add a point; return its number."""
        if self._count == len(self._costs):
            self._points = np.concatenate([self._points, np.empty_like(self._points)])
            self._costs = np.concatenate([self._costs, np.empty_like(self._costs)])
            self._constraints = np.concatenate(
                [self._constraints, np.empty_like(self._constraints)]
            )
        number = self._count
        cost, found = evaluation.cost, evaluation.constraints
        failed = not evaluation.ok or np.isnan(cost)
        self._points[number] = u
        self._costs[number] = np.inf if failed else cost
        self._constraints[number] = np.inf if failed else np.where(np.isnan(found), np.inf, found)
        self._numbers[key(u)] = number
        self._count += 1
        return number

    @property
    def finite(self) -> npt.NDArray[np.bool_]:
        """(points,): True where cost and constraints have values."""
        return np.isfinite(self.costs) & np.isfinite(self.constraints).all(axis=1)

    def quantities(self, numbers: IntArray) -> FloatArray:
        """Return (numbers, 1 + constraints): the costs of some points, then their constraints."""
        return np.column_stack([self.costs[numbers], self.constraints[numbers]])

    def violation(self, number: int, equality: npt.NDArray[np.bool_]) -> float:
        """Return the largest violation of the constraints at a point."""
        found = self.constraints[number]
        return float(np.where(equality, np.abs(found), found).max(initial=0.0))

    def near(self, u: FloatArray, distance: float, most: int) -> IntArray:
        """Return the numbers of points with finite values within a distance of u, nearest first."""
        distances = np.abs(self.points - u).max(axis=1, initial=0.0)
        found = np.flatnonzero(self.finite & (distances <= distance) & (distances > 0.0))
        return found[np.argsort(distances[found], kind="stable")][:most]


def key(u: FloatArray) -> bytes:
    """Return a key that is the same for points that count as the same."""
    return (np.rint(u / ROUNDING) + 0.0).tobytes()
