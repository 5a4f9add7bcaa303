"""A Jacobian as a linear map: as one array, or experiment by experiment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import numpy as np

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.derivatives.differences import ResidualJacobian
from cluster_est.methods.least_squares.bounded_step import StepSolver
from cluster_est.methods.least_squares.factored_blocks import FactoredBlocks
from cluster_est.methods.least_squares.factored_chains import FactoredChains
from cluster_est.methods.least_squares.sparse_step import SparseStepSolver
from workers.messages import FloatArray


class LinearMap(ABC):
    """A weighted Jacobian J."""

    @abstractmethod
    def norms(self) -> FloatArray:
        """Return the norms (unknowns,) of the columns."""

    @abstractmethod
    def transposed_product(self, values: FloatArray) -> FloatArray:
        """Return J'v (unknowns,) of one value for each residual."""

    @abstractmethod
    def product(self, step: FloatArray) -> FloatArray:
        """Return J p (residuals,) of one value for each unknown."""

    @abstractmethod
    def solver(
        self, residuals: FloatArray, scale: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> StepSolver | SparseStepSolver:
        """Return a solver of steps; see `StepSolver`."""


def linear_map(derivatives: ResidualJacobian, factor: FloatArray) -> LinearMap:
    """Return a Jacobian with each row multiplied by a factor, in the form that suits its size."""
    if derivatives.blocks.sparse:
        return _BlockMap(derivatives.blocks.scaled_rows(factor))
    return _DenseMap(factor[:, None] * derivatives.matrix)


@final
class _DenseMap(LinearMap):
    def __init__(self, matrix: FloatArray) -> None:
        self._matrix = matrix

    def norms(self) -> FloatArray:
        return np.asarray(np.linalg.norm(self._matrix, axis=0))

    def transposed_product(self, values: FloatArray) -> FloatArray:
        return np.asarray(self._matrix.T @ values)

    def product(self, step: FloatArray) -> FloatArray:
        return np.asarray(self._matrix @ step)

    def solver(
        self, residuals: FloatArray, scale: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> StepSolver:
        return StepSolver(self._matrix, residuals, scale, lower, upper)


@final
class _BlockMap(LinearMap):
    def __init__(self, matrix: BlockMatrix) -> None:
        self._matrix = matrix

    def norms(self) -> FloatArray:
        return self._matrix.norms()

    def transposed_product(self, values: FloatArray) -> FloatArray:
        return self._matrix.transposed_product(values)

    def product(self, step: FloatArray) -> FloatArray:
        return self._matrix.product(step)

    def solver(
        self, residuals: FloatArray, scale: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> SparseStepSolver:
        factor = FactoredChains if self._matrix.links.any() else FactoredBlocks
        return SparseStepSolver(factor, self._matrix, residuals, scale, lower, upper)
