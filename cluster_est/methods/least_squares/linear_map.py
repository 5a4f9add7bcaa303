"""A Jacobian as a linear map, stored as one array or as one block for each experiment.

It yields the damped Gauss-Newton step within bounds. One factorisation serves many damping factors.
It also yields the reduction that the Gauss-Newton model predicts for a step.

If experiments have unknowns of their own, these are eliminated from the rows of the experiment. The
other rows of its factor depend only on the shared unknowns. So time and memory grow linearly with
the number of experiments, not quadratically. Experiments may share unknowns with their neighbours:
the initial states of a segment of a record occur in the previous segment too. Such unknowns are
eliminated along the chain.

Symbols: J the Jacobian, R a triangular factor, r the residuals, w the weights, D the scaling, p the
step, lambda the damping.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.differences import ResidualJacobian
from cluster_est.methods.least_squares.sparse_step import (
    FactoredJacobian,
    Mask,
    SparseStepSolver,
    eliminate,
    make_chains,
    powers_of_two,
    solve_shared,
)
from cluster_est.methods.method import Evaluation
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray, IntArray

LARGE_MATRIX, PART_OF_MATRIX = 2**21, 2**17
"""Entries of a Jacobian that is factored in parts, and of one part: 16 MB and 1 MB."""

LARGEST_RATIO = 1e10
"""Ratio of column sizes above which columns are scaled before they are factored."""


class StepSolver:
    """Solver that minimises |J p + r|^2 + lambda |D p|^2 subject to lower <= p <= upper.

    J is reduced to its triangular factor once. So the size of the problem for each further damping
    factor is only the number of unknowns.

    Parameters
    ----------
    matrix : (residuals, unknowns)
        J.
    residuals : (residuals,)
        r.
    scale : (unknowns,)
        D, the diagonal.
    lower, upper : (unknowns,)
        Bounds of the step; 0 lies between them.
    """

    def __init__(
        self,
        matrix: FloatArray,
        residuals: FloatArray,
        scale: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
    ) -> None:
        self._units = _units(scale)
        factors = [
            np.linalg.qr(np.column_stack([matrix[part] / self._units, residuals[part]]), mode="r")
            for part in _parts(matrix)
        ]
        whole = factors[0] if len(factors) == 1 else np.linalg.qr(np.vstack(factors), mode="r")
        self._triangle = np.asarray(whole, np.float64)
        self._scale = scale / self._units
        self._lower, self._upper = lower * self._units, upper * self._units

    def step(self, damping: float) -> FloatArray:
        """Return the step for one lambda; it is zero for unknowns whose column is zero."""
        size = len(self._scale)
        factor, right = self._triangle[:, :size], -self._triangle[:, size]
        rows = len(factor)
        system, target = np.zeros((rows + size, size)), np.zeros(rows + size)
        system[:rows], target[:rows] = factor, right
        np.fill_diagonal(system[rows:], np.sqrt(damping) * self._scale)
        free = np.linalg.lstsq(system, target, rcond=None)[0]
        if (free >= self._lower).all() and (free <= self._upper).all():
            return np.asarray(free / self._units)
        from scipy.optimize import lsq_linear  # slow to import, and most steps need no bounds

        bounds = (self._lower, np.maximum(self._upper, np.nextafter(self._lower, np.inf)))
        solved = lsq_linear(system, target, bounds, method="bvls", tol=1e-14).x
        return np.asarray(np.clip(solved, self._lower, self._upper) / self._units)

    def predicted_cost(self, step: FloatArray) -> float:
        """Return |J p + r|^2, the cost that the linear model predicts after a step."""
        moved = np.ones(len(step) + 1)
        moved[:-1] = step * self._units
        values = self._triangle @ moved
        return float(values @ values)


def _parts(matrix: FloatArray) -> list[slice]:
    """Return slices of the rows of a large matrix; one slice for other matrices.

    The factor of a part fits into the cache of a processor and needs little memory. The factor of
    the stacked factors is the factor of the matrix (J. Demmel, L. Grigori, M. Hoemmen, J. Langou,
    SIAM J. Sci. Comput. 34 (2012) A206-A239, doi:10.1137/080731992).
    """
    count, width = matrix.shape
    if matrix.size <= LARGE_MATRIX:
        return [slice(None)]
    rows = max(PART_OF_MATRIX // width, width)
    return [slice(first, first + rows) for first in range(0, count, rows)]


def _units(scale: FloatArray) -> FloatArray:
    """Return powers of two that scale columns of very different sizes to one size; else ones.

    Without scaling, small columns would be lost in the rounding errors of large columns.
    """
    if np.max(scale, initial=0.0) <= LARGEST_RATIO * np.min(scale, initial=np.inf):
        return np.ones_like(scale)
    return powers_of_two(scale)


@dataclass(frozen=True)
class _BlockGroup:
    """Experiments whose triangular factors have one shape and the same shared unknowns.

    Attributes
    ----------
    columns : (experiments, local + shared)
        Indices of the unknowns.
    local
        Number of unknowns that act on one experiment alone.
    factors : (experiments, m, local + shared + 1)
        Triangular factors R of the experiments' Jacobians and residuals.
    """

    columns: IntArray
    local: int
    factors: FloatArray

    def products(self, step: FloatArray) -> FloatArray:
        """Return J p + r (experiments, m), each multiplied by an orthogonal matrix."""
        moved = np.einsum("eij,ej->ei", self.factors[:, :, :-1], step[self.columns])
        return np.asarray(moved + self.factors[:, :, -1])

    def eliminated(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        """Return the damped factors; only their first `local` rows contain local unknowns.

        `roots` is sqrt(lambda) D. Columns of fixed unknowns are zero, and the residuals contain
        the effect of their values.
        """
        count, rows, width = self.factors.shape
        system = np.zeros((count, rows + self.local, width))
        free = ~fixed[self.columns]
        system[:, :rows, :-1] = self.factors[:, :, :-1] * free[:, None, :]
        system[:, :rows, -1] = self.products(np.where(fixed, values, 0.0))
        for j in range(self.local):
            system[:, rows + j, j] = roots[self.columns[:, j]]
        return np.asarray(np.linalg.qr(system, mode="r"))


@final
class FactoredBlocks(FactoredJacobian):
    """Factored J and r of experiments whose shared unknowns are solved together.

    Parameters
    ----------
    matrix
        J.
    residuals : (residuals,)
        r.
    """

    def __init__(self, matrix: BlockMatrix, residuals: FloatArray) -> None:
        shared = matrix.counts > 1
        self._shared = np.flatnonzero(shared)
        self._groups = _grouped(matrix, residuals, shared)

    @override
    def products(self, step: FloatArray) -> Iterator[FloatArray]:
        return (group.products(step) for group in self._groups)

    @override
    def solve(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        step = np.where(fixed, values, 0.0)
        factors = [group.eliminated(fixed, values, roots) for group in self._groups]
        free = ~fixed[self._shared]  # rounding would move the others
        found = solve_shared(self._shared, roots, self._left(factors))
        step[self._shared[free]] = found[free]
        for group, factor in zip(self._groups, factors, strict=True):
            local, width = group.local, group.columns.shape[1]
            p = np.zeros((len(factor), width))
            # the last column contains the effect of fixed ones
            p[:, local:] = np.where(fixed, 0.0, step)[group.columns[:, local:]]
            for j in reversed(range(local)):
                right = np.einsum("ej,ej->e", factor[:, j, j + 1 : -1], p[:, j + 1 :])
                right += factor[:, j, -1]
                pivot = factor[:, j, j]
                p[:, j] = np.where(pivot != 0.0, -right / np.where(pivot, pivot, 1.0), 0.0)
            step[group.columns[:, :local]] = p[:, :local]
        return np.where(fixed, values, step)

    def _left(self, factors: Sequence[FloatArray]) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the shared unknowns of each group and the remaining rows of its experiments."""
        for group, factor in zip(self._groups, factors, strict=True):
            rest = factor[:, group.local :, group.local :]
            stacked = rest.reshape(-1, rest.shape[2])
            triangle = np.asarray(np.linalg.qr(stacked, mode="r"), np.float64)
            yield group.columns[0, group.local :], triangle

    @override
    def gradient(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        result = roots * roots * step
        size = 0.0
        for group in self._groups:
            values = group.products(step)
            terms = np.einsum("eij,ei->ej", group.factors[:, :, :-1], values)
            np.add.at(result, group.columns, terms)
            r = group.factors[:, :, -1]
            size += float(np.add.reduce((values * values + r * r).ravel()))
        return result, float(np.sqrt(size))


def _grouped(matrix: BlockMatrix, residuals: FloatArray, shared: Mask) -> list[_BlockGroup]:
    """Factorise each experiment's rows; group experiments with factors of one shape."""
    groups: dict[tuple[int, int, bytes], list[tuple[IntArray, FloatArray]]] = {}
    for block, columns, rows in zip(matrix.blocks, matrix.columns, matrix.rows, strict=True):
        order = np.argsort(shared[columns], kind="stable")
        chosen = columns[order]
        joined = np.column_stack([block[:, order], residuals[rows]])
        triangle = np.asarray(np.linalg.qr(joined, mode="r"))
        local = int(np.count_nonzero(~shared[columns]))
        key = len(triangle), local, chosen[local:].tobytes()
        groups.setdefault(key, []).append((chosen, triangle))
    found = []
    for (_, local, _), members in groups.items():
        unknowns = np.array([columns for columns, _ in members], np.intp)
        found.append(_BlockGroup(unknowns, local, np.array([triangle for _, triangle in members])))
    return found


@final
class FactoredChains(FactoredJacobian):
    """Factored J and r of experiments that share unknowns with their neighbours.

    Other shared unknowns form the border of the chains.

    Parameters
    ----------
    matrix
        J.
    residuals : (residuals,)
        r.
    """

    def __init__(self, matrix: BlockMatrix, residuals: FloatArray) -> None:
        shared = (matrix.counts > 1) & ~matrix.links
        self._shared = np.flatnonzero(shared)
        self._chains = make_chains(matrix, residuals, shared)

    @override
    def products(self, step: FloatArray) -> Iterator[FloatArray]:
        return (link.products(step) for chain in self._chains for link in chain.links)

    @override
    def solve(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        step = np.where(fixed, values, 0.0)
        chains = [eliminate(chain, fixed, values, roots) for chain in self._chains]
        free = ~fixed[self._shared]  # rounding would move the others
        left = ((each.chain.border, each.rest) for each in chains)
        step[self._shared[free]] = solve_shared(self._shared, roots, left)[free]
        for each in chains:
            # the last column contains the effect of fixed ones
            border = np.where(fixed, 0.0, step)[each.chain.border]
            each.substitute(step, border, 1.0)
        return np.where(fixed, values, step)

    @override
    def gradient(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        result = roots * roots * step
        size = 0.0
        for chain in self._chains:
            for link in chain.links:
                values, r = link.products(step), link.triangle[:, -1]
                result[link.columns] += link.triangle[:, :-1].T @ values
                size += float(np.add.reduce(values * values + r * r))
        return result, float(np.sqrt(size))


class _DenseMatrix:
    """A Jacobian as one array, with the products of a `BlockMatrix`."""

    def __init__(self, matrix: FloatArray) -> None:
        self.matrix = matrix

    def norms(self) -> FloatArray:
        parts = [np.linalg.norm(self.matrix[part], axis=0) for part in _parts(self.matrix)]
        return np.asarray(parts[0] if len(parts) == 1 else np.linalg.norm(parts, axis=0))

    def transposed_product(self, values: FloatArray) -> FloatArray:
        return np.asarray(self.matrix.T @ values)

    def product(self, step: FloatArray) -> FloatArray:
        return np.asarray(self.matrix @ step)


LONGEST_RELATIVE_STEP = 10.0
"""Largest change of an unknown in one step, over its own size.

A longer step can lead to a region where the residuals do not depend on the unknown any more.
"""
LARGEST_RESIDUAL_WEIGHT = 1e200
"""Largest weight of a residual; the weight of an exactly fitted output would be infinite."""


class LocalModel:
    """The Gauss-Newton model of a cost around a point, within bounds.

    With the cost's weights w, the model uses sqrt(w) J and sqrt(w) r in place of J and r. At p = 0,
    |J p + r|^2 then has the gradient of the cost, 2 J'r, so steps are descent directions.

    Parameters
    ----------
    space, x, at, derivatives
        The space, the point, its evaluation and its Jacobian.
    largest : (unknowns,)
        Largest column norms of the Jacobian so far.

    Attributes
    ----------
    squares
        Weighted sum of squares of the residuals. Tolerances are relative to it, because the cost
        itself may be zero or negative.
    scale : (unknowns,)
        Maximum of `largest` and the column norms at this point, the scale of the damping.
    optimality
        Largest cosine between the residuals and a column of an unknown that no bound blocks.
    """

    def __init__(
        self,
        space: SearchSpace,
        x: FloatArray,
        at: Evaluation,
        derivatives: ResidualJacobian,
        largest: FloatArray,
    ) -> None:
        self._roots = np.sqrt(_weights(space, at))
        self._residuals = self._roots * at.residuals
        self._jacobian: BlockMatrix | _DenseMatrix
        if derivatives.blocks.sparse:
            self._jacobian = derivatives.blocks.scaled_rows(self._roots)
        else:
            plain = bool((self._roots == 1.0).all())  # avoids a copy of a large matrix
            matrix = derivatives.matrix
            self._jacobian = _DenseMatrix(matrix if plain else self._roots[:, None] * matrix)
        with np.errstate(over="ignore"):
            self.squares = float(np.add.reduce(self._residuals * self._residuals))
        norms = self._jacobian.norms()
        self.scale = np.maximum(largest, norms)
        gradient = self._jacobian.transposed_product(self._residuals)
        sizes = norms * np.linalg.norm(self._residuals)
        blocked = (x <= space.lower) & (gradient > 0.0)
        blocked |= (x >= space.upper) & (gradient < 0.0)
        free = ~blocked & (sizes > 0.0)
        self.optimality = float(np.max(np.abs(gradient[free]) / sizes[free], initial=0.0))
        unsized = (space.start == 0.0) & ~np.isfinite(space.upper - space.lower)
        longest = np.where(unsized, np.inf, LONGEST_RELATIVE_STEP * unknown_sizes(space, x))
        self._bounds = np.maximum(space.lower - x, -longest), np.minimum(space.upper - x, longest)
        self._diagonal = np.where(self.scale > 0.0, self.scale, 1.0)
        self._walls = derivatives.walls
        self._solver = self._solver_of(self._residuals, *self._bounds)

    def _solver_of(
        self, residuals: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> StepSolver | SparseStepSolver:
        """Return a solver of steps in the form that suits the size of the Jacobian."""
        matrix, scale = self._jacobian, self._diagonal
        if isinstance(matrix, _DenseMatrix):
            return StepSolver(matrix.matrix, residuals, scale, lower, upper)
        factor = FactoredChains if matrix.links.any() else FactoredBlocks
        return SparseStepSolver(factor, matrix, residuals, scale, lower, upper)

    def step(self, damping: float) -> FloatArray:
        """Return the step p that minimises the model plus damping |D p|^2."""
        return self._solver.step(damping)

    def along_walls(self, damping: float) -> FloatArray | None:
        """Return the step that avoids sides on which simulations fail; None without such sides."""
        if not self._walls.any():
            return None
        lower, upper = self._bounds
        lower, upper = np.where(self._walls < 0, 0.0, lower), np.where(self._walls > 0, 0.0, upper)
        return self._solver_of(self._residuals, lower, upper).step(damping)

    def corrected(self, step: FloatArray, at: Evaluation, damping: float) -> FloatArray:
        """Return the step corrected for the curvature of the residuals; `at` is its end."""
        curved = self._roots * at.residuals - self._jacobian.product(step)
        return self._solver_of(curved, *self._bounds).step(damping)

    def predicted_reduction(self, step: FloatArray) -> float:
        """Return the reduction of the cost that the model predicts for a step."""
        return self.squares - self._solver.predicted_cost(step)

    def norm(self, step: FloatArray) -> float:
        """Return |D p|, the length of a step independent of the units of the unknowns."""
        return float(np.linalg.norm(self._diagonal * step))

    def inner_product(self, one: FloatArray, other: FloatArray) -> float:
        """Return the inner product of two steps that belongs to `norm`."""
        return float(np.add.reduce((self._diagonal * one) * (self._diagonal * other)))


def unknown_sizes(space: SearchSpace, x: FloatArray) -> FloatArray:
    """Return the size of each unknown (unknowns,), the scale of relative step lengths."""
    return np.maximum(np.abs(x), space.typical)


def _weights(space: SearchSpace, at: Evaluation) -> FloatArray:
    weights = space.problem.cost.weights(at.residuals, space.outputs)
    if weights is None:
        raise ProblemError(
            "cost.name: must be a cost with weights for a least-squares method, but is "
            f'{space.problem.cost.name!r}; use method.name = "sqp" or another cost'
        )
    return np.clip(weights, 0.0, LARGEST_RESIDUAL_WEIGHT)
