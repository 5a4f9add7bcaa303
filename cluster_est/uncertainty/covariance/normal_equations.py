"""The normal equations of shared and local unknowns, solved experiment by experiment.

An unknown is held at a bound, shared by experiments, or local to one experiment. The residuals of
an experiment depend on the shared unknowns and on its local unknowns. So the Jacobian is a column
of blocks (A_e, B_e), and the local parts are eliminated one block at a time. The part of A_e
orthogonal to B_e contains all information of an experiment on the shared unknowns. The memory is
proportional to the blocks, not to the square of the number of unknowns. The result is that of the
dense (J'J)^-1 (A. Bjorck, Numerical Methods for Least Squares Problems (1996),
doi:10.1137/1.9781611971484, section 6.3). Singular value decompositions are used instead of QR, to
find directions that the data do not determine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.method import TOLERANCE, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty.covariance import accuracy
from workers.messages import FloatArray, IntArray

REPORTED_RATIO_MARGIN = 3.0
"""Ratio of a direction over its limit, below which the direction is reported."""


@dataclass(frozen=True)
class JacobianBlock:
    """The rows of one experiment.

    Attributes
    ----------
    shared : (n, shared)
        Derivatives for the shared unknowns, or for their coordinates.
    local : (n, local)
        Derivatives for the local unknowns. All columns are scaled to a length of about 1.
    """

    shared: FloatArray
    local: FloatArray


@dataclass(frozen=True)
class ErrorLimits:
    """Limits for the error of the product of the Jacobian and a unit vector.

    The error for a vector v is |limits * v|.

    Attributes
    ----------
    shared : (m,)
        Limits of the shared unknowns.
    local
        For each block, limits of its local unknowns.
    embedding : (m, shared)
        Matrix from the blocks' shared coordinates to the shared unknowns.
    """

    shared: FloatArray
    local: tuple[FloatArray, ...]
    embedding: FloatArray


@dataclass(frozen=True)
class UndeterminedCombination:
    """A direction that the data determine badly or not at all.

    Attributes
    ----------
    shared : (m,)
        Components of the shared unknowns.
    local
        Components of each block's local unknowns; empty arrays for blocks without components.
    ratio
        Change of the residuals along the direction, over the changes by each single unknown.
    limit
        The ratio that errors of the derivatives may cause.
    """

    shared: FloatArray
    local: tuple[FloatArray, ...]
    ratio: float
    limit: float

    @property
    def undetermined(self) -> bool:
        """Whether the ratio cannot be distinguished from 0."""
        return self.ratio <= self.limit


@dataclass(frozen=True)
class _EliminatedBlock:
    """A block without its local unknowns.

    Attributes
    ----------
    inverse : (local, n)
        Pseudo-inverse of the local part B.
    response : (local, shared)
        `inverse` A: minus the change of the local unknowns with the shared ones.
    projector : (local, local)
        Projection on the well-determined local directions.
    rest : (n, shared)
        The part of A orthogonal to B.
    rank
        Number of local directions that the block determines.
    """

    inverse: FloatArray
    response: FloatArray
    projector: FloatArray
    rest: FloatArray
    rank: int


@dataclass(frozen=True)
class BlockFactors:
    """Blocks whose local unknowns have been eliminated, and the factors for the shared ones.

    Attributes
    ----------
    inverse : (shared, shared)
        Pseudo-inverse of the normal equations of the shared coordinates.
    rank
        Number of directions that the data determine.
    combinations
        Directions that the data do not determine, or hardly.
    """

    inverse: FloatArray
    parts: tuple[_EliminatedBlock, ...] = field(repr=False)
    rank: int
    combinations: tuple[UndeterminedCombination, ...]


@dataclass(frozen=True)
class BlockCovariance:
    """The covariance of shared coordinates and local unknowns, without pairs from two blocks.

    Attributes
    ----------
    shared : (shared, shared)
    cross
        One matrix (local, shared) for each block.
    local
        One matrix (local, local) for each block.
    """

    shared: FloatArray
    cross: tuple[FloatArray, ...]
    local: tuple[FloatArray, ...]

    def times(self, factor: float) -> BlockCovariance:
        """Return this covariance times a number."""
        return BlockCovariance(
            factor * self.shared,
            tuple(factor * each for each in self.cross),
            tuple(factor * each for each in self.local),
        )


def factorise(blocks: Sequence[JacobianBlock], limits: ErrorLimits, weak: float) -> BlockFactors:
    """Eliminate the local unknowns of each block, and join the remaining parts.

    Parameters
    ----------
    blocks
        Blocks with the same shared coordinates.
    limits
        A direction whose ratio does not exceed them is undetermined and is left out.
    weak
        Directions up to this ratio, or up to `REPORTED_RATIO_MARGIN` times their limit, are also
        reported.
    """
    width = limits.embedding.shape[1]
    parts: list[_EliminatedBlock] = []
    found: list[UndeterminedCombination] = []
    nothing = tuple(np.zeros(0) for _ in blocks)
    triangle = np.zeros((0, width))
    for e, block in enumerate(blocks):
        part, ratios, vectors, limits_of_rows = _eliminate(block, limits.local[e], weak)
        parts.append(part)
        for ratio, vector, edge in zip(ratios, vectors, limits_of_rows, strict=True):
            local = (*nothing[:e], vector, *nothing[e + 1 :])
            found.append(
                UndeterminedCombination(np.zeros(len(limits.shared)), local, float(ratio), edge)
            )
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, part.rest]), mode="r"))
    square = np.zeros((width, width))
    square[: len(triangle)] = triangle
    _, singular, rows = np.linalg.svd(square)
    kept = []
    for value, row in zip(singular, rows, strict=True):
        combination = _complete(value, row, parts, limits)
        kept.append(not combination.undetermined)
        if combination.ratio <= max(weak, REPORTED_RATIO_MARGIN * combination.limit):
            found.append(combination)
    scaled = rows[kept] / singular[kept, None]
    rank = sum(part.rank for part in parts) + sum(kept)
    return BlockFactors(scaled.T @ scaled, tuple(parts), rank, tuple(found))


def block_covariance(
    factors: BlockFactors, noise: Sequence[Callable[[FloatArray], FloatArray]] | None = None
) -> BlockCovariance:
    """Return (J'J)^-1 J'SJ (J'J)^-1 from the factors of J; (J'J)^-1 without S.

    Parameters
    ----------
    factors
        Factors of J.
    noise
        For each block, a function that multiplies columns by S, which is block diagonal.
    """
    if noise is None:
        shared = factors.inverse
        cross = tuple(-part.response @ shared for part in factors.parts)
        own = [part.inverse @ part.inverse.T for part in factors.parts]
        local = [o - c @ p.response.T for o, c, p in zip(own, cross, factors.parts, strict=True)]
        return BlockCovariance(shared, cross, tuple(local))
    influence = [factors.inverse @ part.rest.T for part in factors.parts]
    shared = np.zeros_like(factors.inverse)
    products = [
        (times(each.T), times(part.inverse.T))
        for part, each, times in zip(factors.parts, influence, noise, strict=True)
    ]
    for each, (influenced, _) in zip(influence, products, strict=True):
        shared += each @ influenced
    crossed, locals_ = [], []
    for part, (influenced, inside) in zip(factors.parts, products, strict=True):
        mixed = part.inverse @ influenced
        between = mixed @ part.response.T
        crossed.append(mixed - part.response @ shared)
        locals_.append(
            part.inverse @ inside - between - between.T + part.response @ shared @ part.response.T
        )
    return BlockCovariance(shared, tuple(crossed), tuple(locals_))


def _eliminate(
    block: JacobianBlock, limits: FloatArray, weak: float
) -> tuple[_EliminatedBlock, FloatArray, FloatArray, list[float]]:
    """Eliminate a block's local unknowns.

    Return the block, and the ratios, vectors and limits of badly determined local directions.
    """
    count = block.local.shape[1]
    left, singular, rows = np.linalg.svd(block.local, full_matrices=False)
    if len(singular) < count:  # fewer residuals than local unknowns
        _, _, rows = np.linalg.svd(block.local)
        singular = np.append(singular, np.zeros(count - len(singular)))
        left = np.column_stack([left, np.zeros((len(left), count - left.shape[1]))])
    limits_of_rows = [float(np.linalg.norm(limits * row)) for row in rows]
    kept = singular > limits_of_rows
    bad = singular <= np.maximum(weak, REPORTED_RATIO_MARGIN * np.array(limits_of_rows))
    basis = left[:, kept]
    inverse = (rows[kept].T / singular[kept]) @ basis.T
    rest = block.shared
    for _ in range(2):  # twice, because one projection leaves rounding errors
        rest = rest - basis @ (basis.T @ rest)
    projector = rows[~bad].T @ rows[~bad]
    part = _EliminatedBlock(inverse, inverse @ block.shared, projector, rest, int(kept.sum()))
    return (
        part,
        singular[bad],
        rows[bad],
        [edge for edge, b in zip(limits_of_rows, bad, strict=True) if b],
    )


def _complete(
    singular: float, row: FloatArray, parts: Sequence[_EliminatedBlock], limits: ErrorLimits
) -> UndeterminedCombination:
    """Return a direction of the shared coordinates, with the response of the local unknowns.

    Local directions that a block determines badly are reported separately and left out here.
    """
    shared = limits.embedding @ row
    local = [-part.projector @ (part.response @ row) for part in parts]
    length = float(np.sqrt(1.0 + sum(float(y @ y) for y in local)))
    pairs = zip([limits.shared, *limits.local], [shared, *local], strict=True)
    limit = float(np.sqrt(sum(float(((a * b) ** 2).sum()) for a, b in pairs))) / length
    unit = tuple(y / length for y in local)
    return UndeterminedCombination(shared / length, unit, singular / length, limit)


AT_BOUND = 1e-6
"""Distance from a bound, over an unknown's scale, below which the unknown is held at the bound."""
MUCH_SMALLER_SCALE = 1e-2
"""Scale from the Jacobian, over the typical size, below which it replaces the typical size."""
DETERMINED_BY_CONSTRAINTS = 1e-9
"""Length of an unknown's row in the coordinates below which active constraints determine it."""


ActiveBound = Literal["", "lower", "upper"]


@dataclass(frozen=True)
class UnknownLayout:
    """The free unknowns of a space at a point, shared and local, and its active constraints.

    Attributes
    ----------
    active_bounds
        For each unknown, the bound at which it is held, or "".
    shared
        Free unknowns on which several experiments may depend. Local unknowns in an active
        constraint count as shared.
    local
        For each experiment, its free local unknowns.
    active
        Names of the active constraints on parameters.
    constraint_jacobian : (active, shared)
        Derivatives of the active constraints.
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
    """Return the bound at which each unknown is held, or "".

    Wide bounds, or a start of 0, do not determine an unknown's scale. If the Jacobian is known, the
    scale is at most about the change that changes the residuals by the size of the measurements.
    """
    scale = space.typical
    outputs = accuracy.output_norm(space)
    if jacobian is not None and outputs > 0.0:
        norms = jacobian.norms()
        reach = np.divide(outputs, norms, out=np.full(len(norms), np.inf), where=norms > 0.0)
        scale = np.where(reach < MUCH_SMALLER_SCALE * scale, reach, scale)
    tolerance = AT_BOUND * scale
    low, high = x - space.lower <= tolerance, space.upper - x <= tolerance
    return tuple("lower" if a else "upper" if b else "" for a, b in zip(low, high, strict=True))


def is_shared(space: SearchSpace) -> npt.NDArray[np.bool_]:
    """Return a mask of unknowns that are declared for all experiments or act on several ones."""
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
    """Return the layout at a point whose constraints have these values; some may be missing.

    If `held` is false, unknowns at a bound are free.
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
    """Return an orthonormal basis of the constraints' null space: (shared, coordinates).

    The Jacobian of the constraints is in units of the scaled unknowns.
    """
    count = jacobian.shape[1]
    if not len(jacobian) or not count:
        return np.eye(count)
    lengths = np.linalg.norm(jacobian, axis=1, keepdims=True)
    _, singular, rows = np.linalg.svd(jacobian / lengths)
    rank = int((singular > DETERMINED_BY_CONSTRAINTS * singular[0]).sum())
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
    """Return the Jacobian in blocks; None if the solution has none."""
    dense = solution.jacobian
    if dense is None:
        return solution.block_jacobian
    rows = space.rows if solution.at is None else solution.at.rows
    blocks = [dense[row][:, acting] for row, acting in zip(rows, space.acting, strict=True)]
    return BlockMatrix(tuple(blocks), space.acting, space.size)


def with_jacobian(solution: Solution, jacobian: BlockMatrix) -> Solution:
    """Return the solution with another Jacobian, in the same form as before."""
    if solution.jacobian is None:
        return replace(solution, block_jacobian=jacobian)
    return replace(solution, jacobian=jacobian.dense())
