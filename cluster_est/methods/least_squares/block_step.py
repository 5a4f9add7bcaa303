"""The damped Gauss-Newton step within bounds, experiment by experiment.

The unknowns of one experiment alone are eliminated from its rows by an orthogonal factorisation;
what is left of the rows says all that the experiment knows of the shared unknowns. These are solved
for together, and the others follow (A. Bjorck, Numerical Methods for Least Squares Problems (1996),
doi:10.1137/1.9781611971484, section 6.3). Time and memory grow with the number of experiments, not
with its square.
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
    """Experiments whose triangles have one shape and the same shared unknowns.

    Attributes
    ----------
    columns : (experiments, own + shared)
        Which unknowns.
    own
        How many of them are each experiment's own.
    triangles : (experiments, m, own + shared + 1)
        Of their Jacobians and residuals.
    """

    columns: IntArray
    own: int
    triangles: FloatArray

    def products(self, step: FloatArray) -> FloatArray:
        """(experiments, m): J p + r in the triangles' coordinates."""
        moved = np.einsum("eij,ej->ei", self.triangles[:, :, :-1], step[self.columns])
        return np.asarray(moved + self.triangles[:, :, -1])

    def eliminated(self, fixed: Mask, moved: FloatArray, damping: FloatArray) -> FloatArray:
        """Triangles whose first `own` rows hold all of the experiments' own unknowns.

        `damping` has the root for each unknown. Columns of fixed unknowns are zero, and their
        moves are in the residuals.
        """
        count, rows, width = self.triangles.shape
        system = np.zeros((count, rows + self.own, width))
        free = ~fixed[self.columns]
        system[:, :rows, :-1] = self.triangles[:, :, :-1] * free[:, None, :]
        system[:, :rows, -1] = self.products(np.where(fixed, moved, 0.0))
        for j in range(self.own):
            system[:, rows + j, j] = damping[self.columns[:, j]]
        return np.asarray(np.linalg.qr(system, mode="r"))


class BlockStepSolver:
    """Minimises |J p + r|^2 + damping |D p|^2 subject to lower <= p <= upper.

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
        self._groups = _alike(matrix.over(self._units), residuals, counts > 1)

    def step(self, damping: float) -> FloatArray:
        """The step for one damping factor above 0; it is zero for unknowns without any effect."""
        roots = np.sqrt(damping) * self._scale

        def solve(fixed: Mask, moved: FloatArray) -> FloatArray:
            return self._solve(fixed, moved, roots)

        def slope(step: FloatArray) -> tuple[FloatArray, float]:
            return self._slope(step, roots)

        found = within_bounds(solve, slope, self._lower, self._upper)
        return np.asarray(found / self._units)

    def predicted_cost(self, step: FloatArray) -> float:
        """|J p + r|^2, the cost that the linear model expects after a step."""
        parts = [group.products(step * self._units) for group in self._groups]
        return float(sum(float(np.add.reduce((part * part).ravel())) for part in parts))

    def _solve(self, fixed: Mask, moved: FloatArray, roots: FloatArray) -> FloatArray:
        """The step whose fixed unknowns move as they are told."""
        step = np.where(fixed, moved, 0.0)
        factors = [group.eliminated(fixed, moved, roots) for group in self._groups]
        shared = self._shared[~fixed[self._shared]]  # rounding would move the others
        step[shared] = self._solve_shared(factors, roots)[~fixed[self._shared]]
        for group, factor in zip(self._groups, factors, strict=True):
            own, width = group.own, group.columns.shape[1]
            found = np.zeros((len(factor), width))
            # fixed ones are in the last column already
            found[:, own:] = np.where(fixed, 0.0, step)[group.columns[:, own:]]
            for j in reversed(range(own)):
                right = np.einsum("ej,ej->e", factor[:, j, j + 1 : -1], found[:, j + 1 :])
                right += factor[:, j, -1]
                pivot = factor[:, j, j]
                found[:, j] = np.where(pivot != 0.0, -right / np.where(pivot, pivot, 1.0), 0.0)
            step[group.columns[:, :own]] = found[:, :own]
        return np.where(fixed, moved, step)

    def _solve_shared(self, factors: Sequence[FloatArray], roots: FloatArray) -> FloatArray:
        """Shared unknowns, from what the elimination of the others has left; 0 for fixed ones."""
        count = len(self._shared)
        if not count:
            return np.zeros(0)
        system = np.zeros((count, count + 1))
        system[:, :count] = np.diag(roots[self._shared])
        parts = [system]
        for group, factor in zip(self._groups, factors, strict=True):
            rest = factor[:, group.own :, group.own :]
            stacked = rest.reshape(-1, rest.shape[2])
            triangle = np.asarray(np.linalg.qr(stacked, mode="r"), np.float64)
            part = np.zeros((len(triangle), count + 1))
            part[:, np.searchsorted(self._shared, group.columns[0, group.own :])] = triangle[:, :-1]
            part[:, -1] = triangle[:, -1]
            parts.append(part)
        joined = np.vstack(parts)
        found = np.linalg.lstsq(joined[:, :count], -joined[:, count], rcond=None)[0]
        return np.asarray(found)

    def _slope(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        """Half the gradient of what is minimised, and how large its terms are."""
        result = roots * roots * step
        size = 0.0
        for group in self._groups:
            values = group.products(step)
            terms = np.einsum("eij,ei->ej", group.triangles[:, :, :-1], values)
            np.add.at(result, group.columns, terms)
            own = group.triangles[:, :, -1]
            size += float(np.add.reduce((values * values + own * own).ravel()))
        return result, float(np.sqrt(size))


def _alike(matrix: BlockMatrix, residuals: FloatArray, shared: Mask) -> list[_BlockGroup]:
    """Factor each experiment's rows; put those together that can be treated at once."""
    groups: dict[tuple[int, int, bytes], list[tuple[IntArray, FloatArray]]] = {}
    for part, columns, rows in zip(matrix.parts, matrix.columns, matrix.rows, strict=True):
        order = np.argsort(shared[columns], kind="stable")
        chosen = columns[order]
        joined = np.column_stack([part[:, order], residuals[rows]])
        triangle = np.asarray(np.linalg.qr(joined, mode="r"))
        own = int(np.count_nonzero(~shared[columns]))
        key = len(triangle), own, chosen[own:].tobytes()
        groups.setdefault(key, []).append((chosen, triangle))
    found = []
    for (_, own, _), members in groups.items():
        unknowns = np.array([columns for columns, _ in members], np.intp)
        found.append(_BlockGroup(unknowns, own, np.array([triangle for _, triangle in members])))
    return found
