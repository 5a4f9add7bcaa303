"""The damped Gauss-Newton step within bounds, along chains of experiments.

As `block_step`, where experiments share unknowns with their neighbours: segments of records, whose
first states stand in the rows of the segment before too. Symbols as there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.active_set import within_bounds
from cluster_est.methods.least_squares.chain_elimination import (
    EliminatedChain,
    Mask,
    all_chains,
    make_chains,
)
from workers.messages import FloatArray


class ChainStepSolver:
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
        shared = (matrix.counts > 1) & ~matrix.links
        self._shared = np.flatnonzero(shared)
        self._chains = make_chains(matrix.divided_columns(self._units), residuals, shared)

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
        moved = step * self._units
        parts = [link.products(moved) for chain in self._chains for link in chain.links]
        return float(sum(float(np.add.reduce(part * part)) for part in parts))

    def _solve(self, fixed: Mask, values: FloatArray, roots: FloatArray) -> FloatArray:
        """Return the step with given values of its fixed unknowns."""
        step = np.where(fixed, values, 0.0)
        chains = all_chains(self._chains, fixed, values, roots)
        free = ~fixed[self._shared]  # rounding would move the others
        step[self._shared[free]] = self._solve_shared(chains, roots)[free]
        for each in chains:
            # the last column contains the effect of fixed ones
            border = np.where(fixed, 0.0, step)[each.chain.border]
            each.substitute(step, border, 1.0)
        return np.where(fixed, values, step)

    def _solve_shared(self, chains: Sequence[EliminatedChain], roots: FloatArray) -> FloatArray:
        """Return the shared unknowns, from the rows that the elimination left; 0 for fixed ones."""
        count = len(self._shared)
        if not count:
            return np.zeros(0)
        parts = [np.column_stack([np.diag(roots[self._shared]), np.zeros(count)])]
        for each in chains:
            part = np.zeros((len(each.rest), count + 1))
            part[:, np.searchsorted(self._shared, each.chain.border)] = each.rest[:, :-1]
            part[:, -1] = each.rest[:, -1]
            parts.append(part)
        joined = np.vstack(parts)
        return np.asarray(np.linalg.lstsq(joined[:, :count], -joined[:, count], rcond=None)[0])

    def _gradient(self, step: FloatArray, roots: FloatArray) -> tuple[FloatArray, float]:
        """Return half the gradient of the damped model, and the size of its terms."""
        result = roots * roots * step
        size = 0.0
        for chain in self._chains:
            for link in chain.links:
                values, r = link.products(step), link.triangle[:, -1]
                result[link.columns] += link.triangle[:, :-1].T @ values
                size += float(np.add.reduce(values * values + r * r))
        return result, float(np.sqrt(size))
