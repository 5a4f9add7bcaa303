"""The Jacobian of a solution, experiment by experiment, however the method left it."""

from __future__ import annotations

from dataclasses import replace

from cluster_est.methods.base import Solution
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.problem.space import SearchSpace


def has_slopes(solution: Solution) -> bool:
    return solution.jacobian is not None or solution.block_jacobian is not None


def slopes_of(space: SearchSpace, solution: Solution) -> BlockMatrix | None:
    """The Jacobian in blocks; None where the solution has none."""
    whole = solution.jacobian
    if whole is None:
        return solution.block_jacobian
    rows = space.rows if solution.at is None else solution.at.rows
    parts = [whole[row][:, acting] for row, acting in zip(rows, space.acting, strict=True)]
    return BlockMatrix(tuple(parts), space.acting, space.size)


def with_slopes(solution: Solution, slopes: BlockMatrix) -> Solution:
    """The solution with another Jacobian, kept like its own."""
    if solution.jacobian is None:
        return replace(solution, block_jacobian=slopes)
    return replace(solution, jacobian=slopes.dense())
