"""The Jacobian of a solution, in whichever form the method returned it."""

from __future__ import annotations

from dataclasses import replace

from cluster_est.methods.base import Solution
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.problem.search_space.space import SearchSpace


def has_jacobian(solution: Solution) -> bool:
    """Return whether a solution has a Jacobian, in either form."""
    return solution.jacobian is not None or solution.block_jacobian is not None


def jacobian_blocks(space: SearchSpace, solution: Solution) -> BlockMatrix | None:
    """Return the Jacobian in blocks; None where the solution has none."""
    dense = solution.jacobian
    if dense is None:
        return solution.block_jacobian
    rows = space.rows if solution.at is None else solution.at.rows
    blocks = [dense[row][:, acting] for row, acting in zip(rows, space.acting, strict=True)]
    return BlockMatrix(tuple(blocks), space.acting, space.size)


def with_jacobian(solution: Solution, jacobian: BlockMatrix) -> Solution:
    """Return the solution with another Jacobian, in the form of its own."""
    if solution.jacobian is None:
        return replace(solution, block_jacobian=jacobian)
    return replace(solution, jacobian=jacobian.dense())
