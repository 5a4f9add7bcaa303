"""Projection that removes what the declared parameters could explain.

Symbols: P is the projection, Q the orthonormal basis of the removed directions.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray

NEARLY_DEPENDENT_DIRECTIONS = 1e-6
"""Least singular value, over the largest, of an independent direction."""

NOTHING_LEFT = 1e-12
"""Length of a projected residual, over that before, below which it is rounding error."""


class OrthogonalProjection:
    """P = I - Q Q', where Q is an orthonormal basis of the columns of a matrix.

    If the matrix contains the sensitivities of the residuals to the parameters, P keeps what no
    small change of the parameters can alter. What a refit would absorb is not evidence that the
    model lacks something.

    Parameters
    ----------
    matrix : (n, parameters)
        A matrix in any units: columns are scaled to length 1 before dependent columns are dropped.
        It may have no columns, and columns of zeros.

    Attributes
    ----------
    basis : (n, rank)
        The basis Q.
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
        """Remaining degrees of freedom, n - rank."""
        return len(self.basis) - self.rank

    def remove(self, a: FloatArray) -> FloatArray:
        """Return P a for a vector (n,) or a matrix (n, m)."""
        left: FloatArray = self.basis @ (self.basis.T @ a)
        np.subtract(a, left, out=left)  # in place, because copies of many columns are large
        return left


@dataclass(frozen=True)
class ProjectedResidual:
    """A residual, and the projection that removes the declared parameters from it."""

    projection: OrthogonalProjection = field(repr=False)
    residuals: FloatArray = field(repr=False)


ROUNDING_OF_EIGENVALUES = 1e-13
"""Eigenvalue of a scaled matrix, over the largest one, below which it is rounding error."""


def inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric positive matrix: (n, n).

    The matrix is scaled with its diagonal. Eigenvalues below the rounding error are replaced by it.
    """
    scale, values, vectors = _spectrum(matrix)
    found = (vectors / values) @ vectors.T
    return np.asarray(found / np.outer(scale, scale))


def root_of_inverse(matrix: FloatArray) -> FloatArray:
    """Return L, (n, n), with L L' equal to the inverse of a symmetric positive matrix."""
    scale, values, vectors = _spectrum(matrix)
    return np.asarray((vectors / np.sqrt(values)) / scale[:, None])


def log_determinant(matrix: FloatArray) -> float:
    """Return log|M| of a symmetric positive matrix."""
    scale, values, _ = _spectrum(matrix)
    return float(np.add.reduce(np.log(values)) + 2.0 * np.add.reduce(np.log(scale)))


def _spectrum(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the square root of the diagonal, and the spectrum of the matrix scaled with it."""
    diagonal = np.sqrt(np.diag(matrix))
    scale = np.where(diagonal > 0.0, diagonal, 1.0)
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
    floor = ROUNDING_OF_EIGENVALUES * float(values.max(initial=0.0))
    return scale, np.maximum(values, max(floor, 1e-300)), vectors
