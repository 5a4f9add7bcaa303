"""Inverses and roots of covariances whose unknowns have very different sizes."""

from __future__ import annotations

import numpy as np

from workers.messages import FloatArray

SMALLEST = 1e-13
"""Of the largest eigenvalue of a scaled matrix, below which one is rounding."""


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
    floor = SMALLEST * float(values.max(initial=0.0))
    return scale, np.maximum(values, max(floor, 1e-300)), vectors
