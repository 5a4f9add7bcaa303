"""The damped Gauss-Newton step within bounds, experiment by experiment.

The unknowns of one experiment alone are eliminated from its rows by an orthogonal factorisation;
the other rows of the factor hold all information of the experiment on the shared unknowns. These
are solved for together, and the others follow by back substitution (A. Bjorck, Numerical Methods
for Least Squares Problems (1996), doi:10.1137/1.9781611971484, section 6.3). Time and memory grow
with the number of experiments, not with its square. Symbols: J the Jacobian, r the residuals, D the
scaling, R a triangular factor, p the step, lambda the damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.active_set import within_bounds
from workers.messages import FloatArray, IntArray

Mask = npt.NDArray[np.bool_]


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


class BlockStepSolver:
    """Minimises |J p + r|^2 + lambda |D p|^2 subject to lower <= p <= upper.

    Parameters
    ----------
    matrix
        J.
    residuals : (residuals,)
        r.
    scale : (unknowns,)
        D, the diagonal; positive.
    lower, upper : (unknowns,)
        Bounds of the step; 0 lies between them.
    """

    def __init__(
        self,
        matrix: BlockMatrix,
        residuals: FloatArray,
        scale: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
    ) -> None:
        # powers of two bring the columns to one size and change no digit
        self._units = np.asarray(2.0 ** np.round(np.log2(scale)), np.float64)
        self._scale = scale / self._units
        self._lower, self._upper = lower * self._units, upper * self._units
        counts = np.zeros(matrix.size, np.int64)
        for columns in matrix.columns:
            counts[columns] += 1
        self._shared = np.flatnonzero(counts > 1)
        self._groups = _grouped(matrix.divided_columns(self._units), residuals, counts > 1)

    def step(self, damping: float) -> FloatArray:
        """Return the step for lambda above 0; it is zero for unknowns without any effect."""
        roots = np.sqrt(damping) * self._scale

        def solve(fixed: Mask, values: FloatArray) -> FloatArray:
            return self._solve(fixed, values, roots)

        def gradient(step: FloatArray) -> tuple[FloatArray, float]:
            return self._gradient(step, roots)

        step = within_bounds(solve, gradient, self._lower, self._upper)
        return np.asarray(step / self._units)

    def predicted_cost(self, step: FloatArray) -> float:
        """Return |J p + r|^2, the cost that the linear model predicts after a step."""
        parts = [group.products(step * self._units) for group in self._groups]
        return float(sum(float(np.add.reduce((part * part).ravel())) for part in parts))

    def _solve(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        """Return the step with given values of its fixed unknowns."""
        step = np.where(fixed, values, 0.0)
        factors = [group.eliminated(fixed, values, roots) for group in self._groups]
        shared = self._shared[~fixed[self._shared]]  # rounding would move the others
        step[shared] = self._solve_shared(factors, roots)[~fixed[self._shared]]
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

    def _solve_shared(self, factors: Sequence[FloatArray], roots: FloatArray) -> FloatArray:
        """Return the shared unknowns, from the rows that the elimination left; 0 for fixed ones."""
        count = len(self._shared)
        if not count:
            return np.zeros(0)
        system = np.zeros((count, count + 1))
        system[:, :count] = np.diag(roots[self._shared])
        parts = [system]
        for group, factor in zip(self._groups, factors, strict=True):
            rest = factor[:, group.local :, group.local :]
            stacked = rest.reshape(-1, rest.shape[2])
            triangle = np.asarray(np.linalg.qr(stacked, mode="r"), np.float64)
            part = np.zeros((len(triangle), count + 1))
            part[:, np.searchsorted(self._shared, group.columns[0, group.local :])] = triangle[
                :, :-1
            ]
            part[:, -1] = triangle[:, -1]
            parts.append(part)
        joined = np.vstack(parts)
        return np.asarray(np.linalg.lstsq(joined[:, :count], -joined[:, count], rcond=None)[0])

    def _gradient(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        """Return half the gradient of the damped model, and the size of its terms."""
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
