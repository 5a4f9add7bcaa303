"""Which unknowns are held, which are shared and which belong to one experiment alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import TOLERANCE
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.problem.space import SearchSpace
from cluster_est.uncertainty.covariance.blocks import JacobianBlock
from workers.messages import FloatArray, IntArray

NEAR = 1e-6
"""Of an unknown's scale: closer to a bound than this, it counts as held there."""
HELD = 1e-9
"""Of an unknown's column: less freedom than this, and constraints determine it."""


@dataclass(frozen=True)
class UnknownLayout:
    """How the unknowns of a space stand to each other at a point.

    Attributes
    ----------
    sides
        For each unknown "lower", "upper" or "": the bound that holds it.
    shared
        Free unknowns that several experiments may depend on. An active constraint on local
        unknowns makes them shared.
    local
        For each experiment, its free unknowns.
    active
        Names of the active constraints on parameters.
    slopes : (active, shared)
        Their derivatives.
    ignored
        Names of active constraints on signals, whose derivatives are not known.
    """

    sides: tuple[str, ...]
    shared: IntArray
    local: tuple[IntArray, ...]
    active: tuple[str, ...]
    slopes: FloatArray
    ignored: tuple[str, ...]


def bound_sides(space: SearchSpace, x: FloatArray) -> tuple[str, ...]:
    """Which bound each unknown stands at: "lower", "upper" or ""."""
    near = NEAR * space.typical
    low, high = x - space.lower <= near, space.upper - x <= near
    return tuple("lower" if a else "upper" if b else "" for a, b in zip(low, high, strict=True))


def is_shared(space: SearchSpace) -> npt.NDArray[np.bool_]:
    """(unknowns,): whether an unknown is declared for all experiments, or acts on several."""
    declared = np.array([u.parameter.per is None for u in space.unknowns], dtype=bool)
    several = np.array([len(u.experiments) > 1 for u in space.unknowns], dtype=bool)
    return np.asarray(declared | several)


def lay_out(
    space: SearchSpace, x: FloatArray, constraints: FloatArray, *, held: bool = True
) -> UnknownLayout:
    """Sort the unknowns at a point whose constraints have these values, of which some may lack.

    Unknowns at a bound are free too if not `held`.
    """
    sides = bound_sides(space, x) if held else ("",) * space.size
    free = np.array([not side for side in sides], dtype=bool)
    slopes = space.parameter_constraint_slopes(x)
    values = space.parameter_constraints(x)
    active = np.abs(values) <= TOLERANCE
    active |= space.equality[: len(values)] | (values > 0.0)
    active &= (slopes[:, free] != 0.0).any(axis=1)
    coupled = (slopes[active] != 0.0).any(axis=0)
    shared = is_shared(space) | coupled
    of_signals = range(len(values), len(constraints))
    names = space.constraint_names
    return UnknownLayout(
        sides=sides,
        shared=np.flatnonzero(free & shared),
        local=tuple(acting[(free & ~shared)[acting]] for acting in space.acting),
        active=tuple(names[j] for j in np.flatnonzero(active)),
        slopes=slopes[active][:, free & shared],
        ignored=tuple(
            names[j] for j in of_signals if space.equality[j] or constraints[j] >= -TOLERANCE
        ),
    )


def free_coordinates(slopes: FloatArray) -> FloatArray:
    """(shared, coordinates): an orthonormal basis of the moves that keep all constraints.

    `slopes` is in units of the scaled unknowns.
    """
    count = slopes.shape[1]
    if not len(slopes) or not count:
        return np.eye(count)
    lengths = np.linalg.norm(slopes, axis=1, keepdims=True)
    _, singular, rows = np.linalg.svd(slopes / lengths)
    rank = int((singular > HELD * singular[0]).sum())
    return np.ascontiguousarray(rows[rank:].T)


def blocks(
    matrix: BlockMatrix, layout: UnknownLayout, coordinates: FloatArray
) -> list[JacobianBlock]:
    """Part the blocks of a scaled Jacobian into shared coordinates and local unknowns."""
    place = np.full(matrix.size, -1)
    place[layout.shared] = np.arange(len(layout.shared))
    found = []
    for part, columns, local in zip(matrix.parts, matrix.columns, layout.local, strict=True):
        shared = place[columns] >= 0
        moves = coordinates[place[columns[shared]]]
        own = np.searchsorted(columns, local)
        found.append(JacobianBlock(part[:, shared] @ moves, part[:, own]))
    return found
