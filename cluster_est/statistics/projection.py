"""Projection that takes out what the declared parameters could explain.

Symbols: P the projection, Q the orthonormal basis of what it takes out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray

NEARLY_DEPENDENT_DIRECTIONS = 1e-6
"""Smallest singular value, over the largest, of a direction that counts."""

NOTHING_LEFT = 1e-12
"""Length of a projected residual, over that before, which is the rounding of the projection."""


class OrthogonalProjection:
    """P = I - Q Q', Q an orthonormal basis of the columns of a matrix.

    With the sensitivities of the residuals to the parameters as that matrix, P leaves what no small
    change of the parameters can alter: whatever a refit would absorb is no evidence that something
    is missing.

    Parameters
    ----------
    matrix : (n, parameters)
        Any units: columns are scaled to length 1 before dependent ones are dropped. It may have no
        columns, and columns of zeros.

    Attributes
    ----------
    basis : (n, rank)
        Q.
    """

    def __init__(self, matrix: FloatArray) -> None:
        lengths = np.linalg.norm(matrix, axis=0)
        used = matrix[:, lengths > 0.0] / lengths[lengths > 0.0]
        left, singular, _ = np.linalg.svd(used, full_matrices=False)
        kept = singular > NEARLY_DEPENDENT_DIRECTIONS * singular.max(initial=0.0)
        self.basis: FloatArray = np.ascontiguousarray(left[:, kept])

    @property
    def rank(self) -> int:
        """Number of independent columns."""
        return int(self.basis.shape[1])

    @property
    def degrees(self) -> int:
        """Degrees of freedom that are left, n - rank."""
        return len(self.basis) - self.rank

    def remove(self, a: FloatArray) -> FloatArray:
        """P a, of a vector (n,) or of the columns of a matrix (n, m)."""
        left: FloatArray = self.basis @ (self.basis.T @ a)
        np.subtract(a, left, out=left)  # of many columns each copy is large
        return left


@dataclass(frozen=True)
class ProjectedResidual:
    """A residual, and the projection that takes the declared parameters out of it."""

    projection: OrthogonalProjection = field(repr=False)
    residuals: FloatArray = field(repr=False)


ROUNDING_OF_EIGENVALUES = 1e-13
"""Part of the largest eigenvalue of a scaled matrix, below which another one is rounding."""


def inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric positive matrix, (n, n), in units of its diagonal.

    Eigenvalues that are lost in rounding count as the smallest that would not be.
    """
    scale, values, vectors = _spectrum(matrix)
    found = (vectors / values) @ vectors.T
    return np.asarray(found / np.outer(scale, scale))


def root_of_inverse(matrix: FloatArray) -> FloatArray:
    """Return L with L L' the inverse of a symmetric positive matrix, (n, n)."""
    scale, values, vectors = _spectrum(matrix)
    return np.asarray((vectors / np.sqrt(values)) / scale[:, None])


def log_determinant(matrix: FloatArray) -> float:
    """Return log|M| of a symmetric positive matrix."""
    scale, values, _ = _spectrum(matrix)
    return float(np.add.reduce(np.log(values)) + 2.0 * np.add.reduce(np.log(scale)))


def _spectrum(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the root of the diagonal, and the spectrum of the matrix in units of it."""
    diagonal = np.sqrt(np.diag(matrix))
    scale = np.where(diagonal > 0.0, diagonal, 1.0)
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
    floor = ROUNDING_OF_EIGENVALUES * float(values.max(initial=0.0))
    return scale, np.maximum(values, max(floor, 1e-300)), vectors
