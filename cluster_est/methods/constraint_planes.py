"""Linearisations of constraints at other points, where one does not tell enough.

A constraint on the largest value of a signal over time has an edge wherever two of its peaks are
equally high, and minima like to lie on edges. The derivatives at a point see one side of it only.
Those at points on the other side complete the picture, as in bundle methods (C. Lemarechal,
Nondifferentiable optimization, in: Handbooks in Operations Research 1 (1989) 529-572). A plane is
used as long as the constraint has been above it wherever it was evaluated; so planes that a smooth
constraint bends away from fall out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from workers.messages import FloatArray

MOST_PLANES, MOST_POINTS = 20, 60
INEXACT = 0.3
"""Relative error of a slope from forward differences."""


@dataclass(frozen=True)
class Plane:
    """All constraints, linearised at a point."""

    x: FloatArray
    values: FloatArray
    slopes: FloatArray


@dataclass(frozen=True)
class Cuts:
    """What is known of the constraints besides their derivatives at the present point.

    Attributes
    ----------
    planes
        Their linearisations, the last one last.
    points
        Where they have been evaluated, and to what.
    """

    planes: tuple[Plane, ...] = ()
    points: tuple[tuple[FloatArray, FloatArray], ...] = ()
    edged: frozenset[int] = frozenset()

    def with_plane(self, plane: Plane) -> Cuts:
        return replace(self, planes=(*self.planes, plane)[-MOST_PLANES:])

    def with_edges(self, constraints: Iterable[int]) -> Cuts:
        return replace(self, edged=self.edged.union(constraints))

    def with_points(self, points: list[tuple[FloatArray, FloatArray]]) -> Cuts:
        finite = [point for point in points if np.isfinite(point[1]).all()]
        return replace(self, points=(*self.points, *finite)[-MOST_POINTS:])

    def rows(
        self, x: FloatArray, equality: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
        """Which constraint, value at `x` and slopes of each plane that holds so far."""
        constraints, values = [np.zeros(0, np.intp)], [np.zeros(0)]
        slopes = [np.zeros((0, len(x)))]
        usable = np.zeros(len(equality), dtype=bool)
        usable[list(self.edged)] = True
        for plane in self.planes if self.edged else ():
            if np.array_equal(plane.x, x):
                continue
            holds = np.flatnonzero(self._holds(plane) & usable & ~equality)
            constraints.append(holds)
            values.append(plane.values[holds] + plane.slopes[holds] @ (x - plane.x))
            slopes.append(plane.slopes[holds])
        return np.concatenate(constraints), np.concatenate(values), np.vstack(slopes)

    def _holds(self, plane: Plane) -> npt.NDArray[np.bool_]:
        """Whether each constraint was above the plane at all points."""
        if not self.points:
            return np.ones(len(plane.values), dtype=bool)
        away = np.array([x for x, _ in self.points]) - plane.x
        known = np.array([values for _, values in self.points])
        expected = plane.values + away @ plane.slopes.T
        doubt = INEXACT * (np.abs(plane.values) + np.abs(away) @ np.abs(plane.slopes).T)
        return np.asarray((expected <= known + doubt).all(axis=0))
