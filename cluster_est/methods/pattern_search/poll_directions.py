"""Poll directions of a pattern search, which contain a direction in every half-space.

Near bounds and constraints they must generate the cone of feasible directions. Otherwise a poll may
fail although a step along the boundary lowers the cost: R. M. Lewis, A. Shepherd, V. Torczon,
Implementing generating set search methods for linearly constrained minimization, SIAM J. Sci.
Comput. 29 (2007) 2507-2530.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from scipy.linalg import qr
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.coordinates import NearbyNormals
from cluster_est.methods.method import Method
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

Basis = Literal["2n", "n+1"]
Axes = Literal["aligned", "coordinates", "random"]
NEGLIGIBLE_LENGTH = 1e-8


def reflection(vector: FloatArray) -> FloatArray:
    """Return the Householder matrix that reflects a vector; its rows are orthonormal."""
    unit = vector / np.linalg.norm(vector)
    return np.eye(len(vector)) - 2.0 * np.outer(unit, unit)


def aligned_axes(progress: FloatArray) -> FloatArray:
    """Return orthonormal rows, the first along a vector up to its sign.

    The rows are the coordinate axes if the vector is 0. The axes follow H. H. Rosenbrock, An
    automatic method for finding the greatest or least value of a function, Comput. J. 3 (1960)
    175-184, doi:10.1093/comjnl/3.3.175, but with one reflection.
    """
    length = float(np.linalg.norm(progress))
    if length == 0.0:
        return np.eye(len(progress))
    vector = progress / length
    vector[0] += 1.0 if vector[0] >= 0.0 else -1.0
    return reflection(vector)


def simplex(size: int) -> FloatArray:
    """Return directions (size + 1, size) of unit length to the vertices of a regular simplex."""
    first = np.full((1, size), size**-0.5)
    others = np.sqrt(1.0 + 1.0 / size) * np.eye(size) - size**-1.5 * (np.sqrt(size + 1.0) + 1.0)
    return np.concatenate([first, others])


def directions(axes: FloatArray, basis: Basis, normals: NearbyNormals) -> FloatArray:
    """Return the directions (directions, unknowns) of a poll, of unit length.

    Parameters
    ----------
    axes : (unknowns, unknowns)
        Orthonormal rows.
    basis
        "2n" has both directions of each axis, "n+1" the vertices of a simplex. Near bounds or
        constraints, directions are always along them and along their normals, both ways.
    normals
        Normals of the bounds and constraints within one mesh.
    """
    if len(normals.inequalities) + len(normals.equalities) == 0:
        return np.concatenate([axes, -axes]) if basis == "2n" else simplex(len(axes)) @ axes
    rows = np.concatenate([normals.inequalities, normals.equalities])
    inverse = np.linalg.pinv(rows)
    tangents = _independent(axes - (axes @ inverse) @ rows)
    across = _unit(inverse.T[: len(normals.inequalities)])
    found = [tangents, -tangents, -across, across]
    if np.linalg.matrix_rank(rows) < len(rows):  # a degenerate vertex
        found += [axes, -axes]
    return _distinct(np.concatenate(found))


def _independent(vectors: FloatArray) -> FloatArray:
    """Return orthonormal vectors of the same span, close to the longest of the vectors."""
    if not vectors.any():
        return vectors[:0]
    found, triangle, _ = qr(vectors.T, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(triangle))
    return np.ascontiguousarray(found[:, sizes > NEGLIGIBLE_LENGTH].T)


def _unit(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1)
    long = lengths > NEGLIGIBLE_LENGTH
    found: FloatArray = vectors[long] / lengths[long, None]
    return found


def _distinct(vectors: FloatArray) -> FloatArray:
    """Return the vectors without repetitions."""
    kept: list[FloatArray] = []
    for vector in vectors:
        if all(np.abs(vector - other).max() > NEGLIGIBLE_LENGTH for other in kept):
            kept.append(vector)
    return np.array(kept).reshape(-1, vectors.shape[1])


SearchStep = Literal["none", "latin_hypercube", "quadratic"]


@dataclass(frozen=True)
class PatternMethod(Method):
    """Base class of pattern searches; `PatternSearch` documents the options."""

    needs_residuals: ClassVar[bool] = False
    needs_every_residual: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    basis: Basis = "2n"
    axes: Axes = "aligned"
    search_step: SearchStep = "quadratic"
    search_points: int = field(default=0, metadata={"least": 0})
    initial_mesh: float = field(default=0.25, metadata={"least": 1e-9})
    mesh_tolerance: float = field(default=1e-6, metadata={"least": 1e-10})
    expansion: float = field(default=2.0, metadata={"least": 1.0})
    contraction: float = field(default=0.5, metadata={"least": 0.01})
    max_iterations: int = field(default=1000, metadata={"least": 1})

    @override
    def check(self, space: SearchSpace) -> None:
        if not self.contraction < 1.0:
            raise ProblemError(
                f"method.options.contraction: must be below 1, but is {self.contraction:g}; 0.5, "
                "for example, halves the mesh size if no direction lowers the cost"
            )
