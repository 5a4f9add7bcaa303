"""Coordinates in which a pattern search moves: 0 is the start, 1 a noticeable change.

Bounds and constraints on parameters are kept here, because they cost no simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

EXACT = 1e-9
"""Constraints on parameters are kept to this, in units of their own scale."""
CORRECTIONS = 20
WITH_GIVEN_SLOPES = 4


@dataclass(frozen=True)
class NearbyNormals:
    """What a point lies next to, as directions of unit length that lead out.

    Attributes
    ----------
    sides : (sides, unknowns)
        Outward normals of bounds and of inequalities on parameters within reach.
    equal : (equalities, unknowns)
        Normals of equalities on parameters.
    """

    sides: FloatArray
    equal: FloatArray


@dataclass(frozen=True)
class ScaledCoordinates:
    """The unknowns of a space in units of a noticeable change, counted from the start."""

    space: SearchSpace

    @cached_property
    def unit(self) -> FloatArray:
        """(unknowns,): a noticeable change, or the range of the bounds if that is less."""
        width = self.space.upper - self.space.lower
        return np.where(
            np.isfinite(width), np.minimum(self.space.typical, width), self.space.typical
        )

    @cached_property
    def lower(self) -> FloatArray:
        return (self.space.lower - self.space.start) / self.unit

    @cached_property
    def upper(self) -> FloatArray:
        return (self.space.upper - self.space.start) / self.unit

    def x(self, u: FloatArray) -> FloatArray:
        """The point in search coordinates; exactly on a bound where u is."""
        inside = np.clip(self.space.start + self.unit * u, self.space.lower, self.space.upper)
        inside = np.where(u <= self.lower, self.space.lower, inside)
        return np.where(u >= self.upper, self.space.upper, inside)

    def clip(self, u: FloatArray) -> FloatArray:
        return np.clip(u, self.lower, self.upper)

    @cached_property
    def tied(self) -> int:
        """How many constraints on parameters there are."""
        return len(self.space.parameter_constraints(self.space.start))

    @cached_property
    def _equality(self) -> npt.NDArray[np.bool_]:
        return self.space.equality[: self.tied]

    def _excess(self, u: FloatArray) -> FloatArray:
        """Constraints on parameters, those that are satisfied as 0."""
        found = self.space.parameter_constraints(self.x(u))
        return np.where(~self._equality & (found <= 0.0), 0.0, found)

    def _slopes(self, u: FloatArray) -> FloatArray:
        return self.space.parameter_constraint_slopes(self.x(u)) * self.unit

    def allowed(self, u: FloatArray) -> bool:
        """Whether u satisfies the constraints on parameters."""
        return not self.tied or bool(np.all(np.abs(self._excess(u)) <= EXACT))

    def repaired(self, u: FloatArray, slopes: FloatArray | None = None) -> FloatArray | None:
        """A point close to u within bounds and constraints on parameters; None if none is found.

        Gauss-Newton steps of least length; `slopes` are derivatives that will do at first.
        """
        u = self.clip(u)
        held = np.zeros(len(u), dtype=bool)
        for i in range(CORRECTIONS if self.tied else 0):
            excess = self._excess(u)
            if np.isnan(excess).any():
                return None
            wrong = np.abs(excess) > EXACT
            if not wrong.any():
                return u
            known = slopes if slopes is not None and i < WITH_GIVEN_SLOPES else self._slopes(u)
            matrix = np.where(held, 0.0, known[wrong])
            moved = u - np.linalg.pinv(matrix) @ excess[wrong]
            held |= (moved < self.lower) | (moved > self.upper)
            u = self.clip(moved)
        return u if self.allowed(u) else None

    def near(self, u: FloatArray, reach: float) -> tuple[NearbyNormals, FloatArray]:
        """What lies within `reach` of u, and the slopes of the constraints on parameters there."""
        axes = np.eye(len(u))
        sides = [axes[self.upper - u <= reach], -axes[u - self.lower <= reach]]
        equal = np.zeros((0, len(u)))
        slopes = self._slopes(u) if self.tied else equal
        if self.tied:
            slack = -self.space.parameter_constraints(self.x(u))
            rates = np.linalg.norm(slopes, axis=1)
            normals = slopes / np.where(rates > 0.0, rates, 1.0)[:, None]
            close = (rates > 0.0) & ~self._equality & (slack <= reach * rates)
            sides.append(normals[close])
            equal = normals[self._equality & (rates > 0.0)]
        return NearbyNormals(np.concatenate(sides), equal), slopes
