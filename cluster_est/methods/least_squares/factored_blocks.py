"""A Jacobian that is factored experiment by experiment, where each has unknowns of its own.

The unknowns of one experiment alone are eliminated from its rows; the other rows of the factor hold
all information of the experiment on the shared unknowns. Time and memory grow with the number of
experiments, not with its square. Symbols as in `sparse_step`; R is a triangular factor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from typing_extensions import override

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.sparse_step import FactoredJacobian, Mask, solve_shared
from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class _BlockGroup:
    """Experiments whose triangular factors have one shape and the same shared unknowns.

    Attributes
    ----------
    columns : (experiments, local + shared)
        Indices of the unknowns.
    local
        Number of those that act on one experiment alone.
    factors : (experiments, m, local + shared + 1)
        R of their Jacobians and residuals.
    """

    columns: IntArray
    local: int
    factors: FloatArray

    def products(self, step: FloatArray) -> FloatArray:
        """Return J p + r (experiments, m), each multiplied by an orthogonal matrix."""
        moved = np.einsum("eij,ej->ei", self.factors[:, :, :-1], step[self.columns])
        return np.asarray(moved + self.factors[:, :, -1])

    def eliminated(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        """Return the damped factors, whose first `local` rows hold all of the local unknowns.

        `roots` has sqrt(lambda) D. Columns of fixed unknowns are zero, and the residuals contain
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
    """J and r of experiments that share unknowns, if any, with all others.

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
        """Give the shared unknowns of each group, and all that its experiments say of them."""
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
    """Factorise each experiment's rows; group those that can be treated at once."""
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
