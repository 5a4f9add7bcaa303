"""What a simplex search moves: n + 1 vertices in n unknowns, and where a vertex may go."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.coordinates import ScaledCoordinates
from workers.messages import FloatArray


@dataclass(frozen=True)
class SimplexVertex:
    """A point in the coordinates of a `ScaledCoordinates`, and what it is worth."""

    u: FloatArray
    at: Evaluation = field(repr=False)

    @property
    def cost(self) -> float:
        """Infinite where a simulation failed; no constraints are looked at."""
        return self.at.rank[1]


@dataclass(frozen=True)
class VertexMoves:
    """Where a vertex goes along the line through the centre of the others.

    Each is the distance from the centre, in units of the vertex's own; negative on the far side.
    `shrink` is by how much all vertices approach the best when no vertex can be improved.
    """

    reflect: float = -1.0
    expand: float = -2.0
    outside: float = -0.5
    inside: float = 0.5
    shrink: float = 0.5

    @property
    def along(self) -> tuple[float, ...]:
        """All that a path may ask for."""
        return self.reflect, self.expand, self.outside, self.inside

    def path(
        self, vertex: SimplexVertex, kept: list[SimplexVertex]
    ) -> Generator[float, SimplexVertex, SimplexVertex]:
        """What a vertex tries one after the other, as distances; where it ends.

        It ends as the vertex itself if nothing is better. Of the vertices that are `kept` the
        first is the best and the last the worst.
        """
        reflected = yield self.reflect
        if reflected.cost < kept[0].cost:
            expanded = yield self.expand
            return expanded if expanded.cost < reflected.cost else reflected
        if reflected.cost < kept[-1].cost:
            return reflected
        if reflected.cost < vertex.cost:
            contracted = yield self.outside
            return contracted if contracted.cost <= reflected.cost else vertex
        contracted = yield self.inside
        return contracted if contracted.cost < vertex.cost else vertex

    @classmethod
    def adaptive(cls, size: int) -> VertexMoves:
        """Those for many unknowns, of Gao and Han; the usual ones for two, and for one."""
        n = max(size, 2)
        contraction = 0.75 - 0.5 / n
        return cls(-1.0, -1.0 - 2.0 / n, -contraction, contraction, 1.0 - 1.0 / n)


def around(frame: ScaledCoordinates, u: FloatArray, step: float) -> FloatArray:
    """(unknowns, 2, unknowns): a step along each axis, up and down, as far as bounds allow."""
    steps = step * np.eye(len(u))
    return frame.clip(np.stack([u + steps, u - steps], axis=1))


def corners(frame: ScaledCoordinates, u: FloatArray, step: float) -> FloatArray:
    """(unknowns, unknowns): a step along each axis, up, or down where there is more room."""
    both = around(frame, u, step)
    lengths = np.abs(both - u).max(axis=2)
    further: FloatArray = both[np.arange(len(u)), np.argmax(lengths, axis=1)]
    return further


def diameter(simplex: list[SimplexVertex]) -> float:
    """The largest distance of a vertex from the first, along any axis."""
    return max(float(np.abs(v.u - simplex[0].u).max()) for v in simplex)


def spread(simplex: list[SimplexVertex]) -> float:
    """By how much the last vertex is worse than the first."""
    return simplex[-1].cost - simplex[0].cost


def ordered(vertices: Iterable[SimplexVertex]) -> list[SimplexVertex]:
    """Best first; those that are as good as each other keep their order."""
    return sorted(vertices, key=lambda v: v.cost)
