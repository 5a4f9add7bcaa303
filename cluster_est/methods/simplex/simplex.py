"""A simplex of n + 1 vertices in n unknowns, and the moves of its vertices."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.coordinates import ScaledCoordinates
from workers.messages import FloatArray


@dataclass(frozen=True)
class SimplexVertex:
    """A point in the coordinates of a `ScaledCoordinates`, and its evaluation."""

    u: FloatArray
    at: Evaluation = field(repr=False)

    @property
    def cost(self) -> float:
        """Infinite where a simulation failed; constraints are ignored."""
        return self.at.rank[1]


@dataclass(frozen=True)
class VertexMoves:
    """Coefficients of the moves of a vertex along the line through the centre of the others.

    Each is the distance from the centre, in units of the vertex's own; negative on the far side.
    `shrink` is the factor of all distances from the best vertex when no move helps.
    """

    reflect: float = -1.0
    expand: float = -2.0
    outside: float = -0.5
    inside: float = 0.5
    shrink: float = 0.5

    @property
    def along(self) -> tuple[float, ...]:
        """All moves that a path may request."""
        return self.reflect, self.expand, self.outside, self.inside

    def path(
        self, vertex: SimplexVertex, fixed: list[SimplexVertex]
    ) -> Generator[float, SimplexVertex, SimplexVertex]:
        """Yield the moves that a vertex tries one after the other; return where it ends.

        That is the vertex itself if nothing is better. Of the vertices that are `fixed` the
        first is the best and the last the worst.
        """
        reflected = yield self.reflect
        if reflected.cost < fixed[0].cost:
            expanded = yield self.expand
            return expanded if expanded.cost < reflected.cost else reflected
        if reflected.cost < fixed[-1].cost:
            return reflected
        if reflected.cost < vertex.cost:
            contracted = yield self.outside
            return contracted if contracted.cost <= reflected.cost else vertex
        contracted = yield self.inside
        return contracted if contracted.cost < vertex.cost else vertex

    @classmethod
    def adaptive(cls, size: int) -> VertexMoves:
        """Return the coefficients of Gao and Han; the usual ones for one or two unknowns."""
        n = max(size, 2)
        contraction = 0.75 - 0.5 / n
        return cls(-1.0, -1.0 - 2.0 / n, -contraction, contraction, 1.0 - 1.0 / n)


def axis_points(coordinates: ScaledCoordinates, u: FloatArray, step: float) -> FloatArray:
    """Return (unknowns, 2, unknowns): steps up and down each axis, as far as bounds allow."""
    steps = step * np.eye(len(u))
    return coordinates.clip(np.stack([u + steps, u - steps], axis=1))


def corners(coordinates: ScaledCoordinates, u: FloatArray, step: float) -> FloatArray:
    """Return (unknowns, unknowns): a step up each axis, or down where bounds allow a longer one."""
    both = axis_points(coordinates, u, step)
    lengths = np.abs(both - u).max(axis=2)
    further: FloatArray = both[np.arange(len(u)), np.argmax(lengths, axis=1)]
    return further


def diameter(simplex: list[SimplexVertex]) -> float:
    """Return the largest distance of a vertex from the first, along any axis."""
    return max(float(np.abs(v.u - simplex[0].u).max()) for v in simplex)


def spread(simplex: list[SimplexVertex]) -> float:
    """Return the difference of the costs of the last vertex and the first."""
    return simplex[-1].cost - simplex[0].cost


def ordered(vertices: Iterable[SimplexVertex]) -> list[SimplexVertex]:
    """Return the vertices, best first; those of the same cost keep their order."""
    return sorted(vertices, key=lambda v: v.cost)
