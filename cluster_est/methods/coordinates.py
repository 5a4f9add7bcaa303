"""Scaled coordinates of direct searches: 0 is the start, 1 is a noticeable change.

Points can be projected on bounds and on constraints on parameters, without a simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

PARAMETER_CONSTRAINT_TOLERANCE = 1e-9
"""Largest violation of constraints on parameters, in units of their own scale."""
PROJECTION_STEPS = 20
STEPS_WITH_GIVEN_JACOBIAN = 4


@dataclass(frozen=True)
class NearbyNormals:
    """Normals of the constraints near a point, of unit length.

    Attributes
    ----------
    inequalities : (inequalities, unknowns)
        Outward normals of nearby bounds and inequalities on parameters.
    equalities : (equalities, unknowns)
        Normals of equalities on parameters.
    """

    inequalities: FloatArray
    equalities: FloatArray


@dataclass(frozen=True)
class ScaledCoordinates:
    """The unknowns of a space relative to the start, in units of a noticeable change."""

    space: SearchSpace

    @cached_property
    def unit(self) -> FloatArray:
        """A noticeable change, or the range of the bounds if that is smaller, (unknowns,)."""
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
        """Return the point in search coordinates; it is exactly on a bound if u is."""
        inside = np.clip(self.space.start + self.unit * u, self.space.lower, self.space.upper)
        inside = np.where(u <= self.lower, self.space.lower, inside)
        return np.where(u >= self.upper, self.space.upper, inside)

    def clip(self, u: FloatArray) -> FloatArray:
        return np.clip(u, self.lower, self.upper)

    @cached_property
    def parameter_constraint_count(self) -> int:
        """Number of constraints on parameters."""
        return len(self.space.parameter_constraints(self.space.start))

    @cached_property
    def _equality(self) -> npt.NDArray[np.bool_]:
        return self.space.equality[: self.parameter_constraint_count]

    def _violations(self, u: FloatArray) -> FloatArray:
        """Return the violations of the constraints on parameters, 0 for satisfied ones."""
        found = self.space.parameter_constraints(self.x(u))
        return np.where(~self._equality & (found <= 0.0), 0.0, found)

    def _jacobian(self, u: FloatArray) -> FloatArray:
        """Return the derivatives of the constraints on parameters by u."""
        return self.space.parameter_constraint_jacobian(self.x(u)) * self.unit

    def is_feasible(self, u: FloatArray) -> bool:
        """Return whether u satisfies the constraints on parameters."""
        return not self.parameter_constraint_count or bool(
            np.all(np.abs(self._violations(u)) <= PARAMETER_CONSTRAINT_TOLERANCE)
        )

    def projected(self, u: FloatArray, jacobian: FloatArray | None = None) -> FloatArray | None:
        """Return a point close to u that satisfies bounds and constraints on parameters, if found.

        It uses Gauss-Newton steps of least length. `jacobian` holds derivatives for the first
        steps.
        """
        u = self.clip(u)
        at_bound = np.zeros(len(u), dtype=bool)
        for i in range(PROJECTION_STEPS if self.parameter_constraint_count else 0):
            violations = self._violations(u)
            if np.isnan(violations).any():
                return None
            violated = np.abs(violations) > PARAMETER_CONSTRAINT_TOLERANCE
            if not violated.any():
                return u
            if jacobian is not None and i < STEPS_WITH_GIVEN_JACOBIAN:
                rows = jacobian
            else:
                rows = self._jacobian(u)
            matrix = np.where(at_bound, 0.0, rows[violated])
            moved = u - np.linalg.pinv(matrix) @ violations[violated]
            at_bound |= (moved < self.lower) | (moved > self.upper)
            u = self.clip(moved)
        return u if self.is_feasible(u) else None

    def normals_near(self, u: FloatArray, distance: float) -> tuple[NearbyNormals, FloatArray]:
        """Return the normals within a distance of u, and the constraints' Jacobian."""
        axes = np.eye(len(u))
        inequalities = [axes[self.upper - u <= distance], -axes[u - self.lower <= distance]]
        equalities = np.zeros((0, len(u)))
        jacobian = self._jacobian(u) if self.parameter_constraint_count else equalities
        if self.parameter_constraint_count:
            slack = -self.space.parameter_constraints(self.x(u))
            norms = np.linalg.norm(jacobian, axis=1)
            normals = jacobian / np.where(norms > 0.0, norms, 1.0)[:, None]
            close = (norms > 0.0) & ~self._equality & (slack <= distance * norms)
            inequalities.append(normals[close])
            equalities = normals[self._equality & (norms > 0.0)]
        return NearbyNormals(np.concatenate(inequalities), equalities), jacobian
