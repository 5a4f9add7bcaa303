"""The unknowns at a solution: held at bounds, shared by experiments, or local to one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.method import TOLERANCE, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty.covariance import accuracy
from cluster_est.uncertainty.covariance.blocks import JacobianBlock
from workers.messages import FloatArray, IntArray

AT_BOUND = 1e-6
"""Of an unknown's scale: closer to a bound than this, it counts as held there."""
MUCH_SMALLER = 1e-2
"""Of the typical size: the scale that the Jacobian shows counts where it is below this part."""
HELD = 1e-9
"""Part of an unknown's column below which active constraints determine it."""


ActiveBound = Literal["", "lower", "upper"]


@dataclass(frozen=True)
class UnknownLayout:
    """The free unknowns of a space at a point, shared and local, and its active constraints.

    Attributes
    ----------
    active_bounds
        For each unknown the bound that holds it, or "".
    shared
        Free unknowns that several experiments may depend on. An active constraint on local
        unknowns makes them shared.
    local
        For each experiment, its free unknowns.
    active
        Names of the active constraints on parameters.
    constraint_jacobian : (active, shared)
        Their derivatives.
    ignored
        Names of active constraints on signals, whose derivatives are not known.
    """

    active_bounds: tuple[ActiveBound, ...]
    shared: IntArray
    local: tuple[IntArray, ...]
    active: tuple[str, ...]
    constraint_jacobian: FloatArray
    ignored: tuple[str, ...]


def active_bounds(
    space: SearchSpace, x: FloatArray, jacobian: BlockMatrix | None = None
) -> tuple[ActiveBound, ...]:
    """Return the bound that each unknown is at, or "".

    Wide bounds, or a start of 0, say little of an unknown's scale. Where the Jacobian is known, a
    change that would change the residuals by all that was measured is not much smaller than it.
    """
    scale = space.typical
    outputs = accuracy.output_norm(space)
    if jacobian is not None and outputs > 0.0:
        norms = jacobian.norms()
        reach = np.divide(outputs, norms, out=np.full(len(norms), np.inf), where=norms > 0.0)
        scale = np.where(reach < MUCH_SMALLER * scale, reach, scale)
    tolerance = AT_BOUND * scale
    low, high = x - space.lower <= tolerance, space.upper - x <= tolerance
    return tuple("lower" if a else "upper" if b else "" for a, b in zip(low, high, strict=True))


def is_shared(space: SearchSpace) -> npt.NDArray[np.bool_]:
    """Return (unknowns,): True if declared for all experiments, or acting on several."""
    declared = np.array([u.parameter.per is None for u in space.unknowns], dtype=bool)
    several = np.array([len(u.experiments) > 1 for u in space.unknowns], dtype=bool)
    return np.asarray(declared | several)


def unknown_layout(
    space: SearchSpace,
    x: FloatArray,
    constraints: FloatArray,
    *,
    held: bool = True,
    jacobian: BlockMatrix | None = None,
) -> UnknownLayout:
    """Return the layout at a point whose constraints have these values, of which some may lack.

    Unknowns at a bound are free too if not `held`.
    """
    at_bounds = active_bounds(space, x, jacobian)
    if not held:
        at_bounds = tuple("" for _ in at_bounds)
    free = np.array([not bound for bound in at_bounds], dtype=bool)
    slopes = space.parameter_constraint_jacobian(x)
    values = space.parameter_constraints(x)
    active = np.abs(values) <= TOLERANCE
    active |= space.equality[: len(values)] | (values > 0.0)
    active &= (slopes[:, free] != 0.0).any(axis=1)
    coupled = (slopes[active] != 0.0).any(axis=0)
    shared = is_shared(space) | coupled
    of_signals = range(len(values), len(constraints))
    names = space.constraint_names
    return UnknownLayout(
        active_bounds=at_bounds,
        shared=np.flatnonzero(free & shared),
        local=tuple(acting[(free & ~shared)[acting]] for acting in space.acting),
        active=tuple(names[j] for j in np.flatnonzero(active)),
        constraint_jacobian=slopes[active][:, free & shared],
        ignored=tuple(
            names[j] for j in of_signals if space.equality[j] or constraints[j] >= -TOLERANCE
        ),
    )


def null_space(jacobian: FloatArray) -> FloatArray:
    """Return (shared, coordinates): an orthonormal basis of the constraints' null space.

    Their Jacobian is in units of the scaled unknowns.
    """
    count = jacobian.shape[1]
    if not len(jacobian) or not count:
        return np.eye(count)
    lengths = np.linalg.norm(jacobian, axis=1, keepdims=True)
    _, singular, rows = np.linalg.svd(jacobian / lengths)
    rank = int((singular > HELD * singular[0]).sum())
    return np.ascontiguousarray(rows[rank:].T)


def blocks(
    matrix: BlockMatrix, layout: UnknownLayout, coordinates: FloatArray
) -> list[JacobianBlock]:
    """Split the blocks of a scaled Jacobian into shared coordinates and local unknowns."""
    place = np.full(matrix.size, -1)
    place[layout.shared] = np.arange(len(layout.shared))
    found = []
    for block, columns, local in zip(matrix.blocks, matrix.columns, layout.local, strict=True):
        shared = place[columns] >= 0
        basis = coordinates[place[columns[shared]]]
        own = np.searchsorted(columns, local)
        found.append(JacobianBlock(block[:, shared] @ basis, block[:, own]))
    return found


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
