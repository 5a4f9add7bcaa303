"""A Jacobian that is factored along chains of experiments.

As `factored_blocks`, where experiments share unknowns with their neighbours: segments of records,
whose first states stand in the rows of the segment before too. Symbols as in `sparse_step`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np
from typing_extensions import override

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.chain_elimination import eliminate, make_chains
from cluster_est.methods.least_squares.sparse_step import FactoredJacobian, Mask, solve_shared
from workers.messages import FloatArray


@final
class FactoredChains(FactoredJacobian):
    """J and r of experiments that share unknowns with the next one, and some with all others.

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
