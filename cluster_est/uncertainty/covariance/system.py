"""The weighted, scaled Jacobian at a solution, factored, and what the data do not determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.methods.base import Solution
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.problem.space import SearchSpace
from cluster_est.uncertainty.covariance import accuracy
from cluster_est.uncertainty.covariance.blocks import (
    BlockCovariance,
    BlockFactors,
    ErrorLimits,
    UndeterminedCombination,
    covariance,
    factorise,
)
from cluster_est.uncertainty.covariance.directions import (
    UndeterminedDirection,
    direction,
    sparse_basis,
)
from cluster_est.uncertainty.covariance.jacobian import slopes_of
from cluster_est.uncertainty.covariance.layout import UnknownLayout, blocks, free_coordinates
from cluster_est.uncertainty.covariance.weighting import ResidualScatter, RowWeighting, weigh
from workers.messages import FloatArray

WEAK = 1e-6
"""Directions up to this ratio are named as hardly determined."""
PART = 1e-6
"""Less of an unknown than this in a direction is rounding."""


@dataclass(frozen=True)
class ScaledJacobian:
    """What a Jacobian says, in scaled unknowns: x times `scale`.

    Attributes
    ----------
    layout, unheld
        Which unknowns are free, shared and local; and if bounds held none of them.
    scale : (unknowns,)
        Norms of the weighted columns; 1 for those that are 0.
    coordinates : (shared, coordinates)
        The moves of the shared unknowns that keep the active constraints.
    factors, found
        The eliminated blocks, and their covariance, `scatter.variance` left out.
    bad
        Directions that the data do not determine, or hardly, if bounds held nothing: a search
        goes along such a direction until a bound stops it, which determines nothing either.
    lost : (directions, unknowns)
        What the data do not determine.
    part
        Less of an unknown than this in `lost` is an error of the derivatives.
    """

    layout: UnknownLayout
    unheld: UnknownLayout
    weighting: RowWeighting
    scale: FloatArray
    coordinates: FloatArray
    factors: BlockFactors
    found: BlockCovariance
    scatter: ResidualScatter
    bad: tuple[UndeterminedCombination, ...]
    lost: FloatArray
    part: float


def build(
    space: SearchSpace,
    solution: Solution,
    layout: UnknownLayout,
    unheld: UnknownLayout,
    reach: float,
    weak: float = WEAK,
) -> ScaledJacobian:
    """Weight, scale and factor the Jacobian of a solution.

    `reach` is the relative step with which its bad directions were measured; 0 if they were not.
    Up to the ratio `weak` a direction is bad.
    """
    slopes = slopes_of(space, solution)
    assert slopes is not None
    weighting, rows = _weighting(space, solution, slopes.height)
    matrix = slopes.weighted(weighting.factor)
    norms = matrix.norms()
    scale = np.where(norms > 0.0, norms, 1.0)
    limits = _limits(space, solution, weighting, norms, reach)
    noise = limits >= 1.0  # such columns would mix with others that are determined
    matrix, limits[noise] = matrix.over(np.where(noise, np.inf, scale)), accuracy.ROUNDING
    coordinates = free_coordinates(layout.slopes / scale[layout.shared])
    factors = _factorise(matrix, layout, coordinates, limits, weak)
    bad = factors.combinations
    if any(layout.sides):
        moves = free_coordinates(unheld.slopes / scale[unheld.shared])
        bad = _factorise(matrix, unheld, moves, limits, weak).combinations
    scatter = weighting.scatter(factors.rank)
    spread = None if scatter.spread is None else [scatter.spread[row] for row in rows]
    chosen = [c for c in bad if c.lost]
    part = max([PART, *(c.limit for c in chosen)])
    return ScaledJacobian(
        layout=layout,
        unheld=unheld,
        weighting=weighting,
        scale=scale,
        coordinates=coordinates,
        factors=factors,
        found=covariance(factors, spread),
        scatter=scatter,
        bad=bad,
        lost=sparse_basis(vectors(space, unheld, chosen), part),
        part=part,
    )


def _factorise(
    matrix: BlockMatrix,
    layout: UnknownLayout,
    coordinates: FloatArray,
    limits: FloatArray,
    weak: float,
) -> BlockFactors:
    parts = blocks(matrix, layout, coordinates)
    local = tuple(limits[each] for each in layout.local)
    return factorise(parts, ErrorLimits(limits[layout.shared], local, coordinates), weak)


def directions(
    space: SearchSpace, x: FloatArray, system: ScaledJacobian
) -> tuple[UndeterminedDirection, ...]:
    """The directions that the data do not determine, then those that they hardly do."""
    lost = [c for c in system.bad if c.lost]
    weak = [c for c in system.bad if not c.lost]
    ratio = max((c.ratio for c in lost), default=0.0)
    limit = max((c.limit for c in lost), default=0.0)
    moves = system.lost / system.scale
    found = [direction(space, x, move, ratio, limit, lost=True) for move in moves]
    for combination in weak:
        (move,) = vectors(space, system.unheld, [combination]) / system.scale
        ratio, limit = combination.ratio, combination.limit
        found.append(direction(space, x, move, ratio, limit, lost=False))
    return tuple(found)


def vectors(
    space: SearchSpace, layout: UnknownLayout, combinations: Sequence[UndeterminedCombination]
) -> FloatArray:
    """(combinations, unknowns): combinations in the order of the space's unknowns."""
    result = np.zeros((len(combinations), space.size))
    for row, combination in zip(result, combinations, strict=True):
        row[layout.shared] = combination.shared
        for local, part in zip(layout.local, combination.local, strict=True):
            if len(part):
                row[local] = part
    return result


def _weighting(
    space: SearchSpace, solution: Solution, count: int
) -> tuple[RowWeighting, list[slice]]:
    """Row weights, and where each experiment's rows stand."""
    if solution.at is not None:
        rows, cost = solution.at.rows, space.problem.cost
        return weigh(cost, solution.at.residuals, space.outputs, rows), rows
    # a sum of squares needs no more than its value
    squares = np.full(count, solution.cost / max(count, 1))
    return RowWeighting(np.ones(count), squares=squares), list(space.rows)


def _limits(
    space: SearchSpace, solution: Solution, weighting: RowWeighting, norms: FloatArray, reach: float
) -> FloatArray:
    """The relative error of each column."""
    x = solution.x
    sensitivity = norms * accuracy.sizes(space, x)
    known = accuracy.output_norm(space, weighting.factor)
    outputs = max(known, float(sensitivity.max(initial=0.0)))
    if reach > 0.0:
        return accuracy.measured_errors(space, sensitivity, outputs, reach)
    return accuracy.column_errors(space, x, sensitivity, outputs, solution.difference_steps)
