"""The weighted, scaled and factorised Jacobian at a solution, and undetermined directions.

The weights of its rows and the scatter of the residuals follow from the cost. A cost F has the
gradient 2 J'psi with psi = w r (`Cost.weights`). So the covariance of its minimum is that of an
M-estimator, A^-1 B A^-1 with A = J' diag(psi') J and B = J' diag(psi^2) J (P. J. Huber, Robust
Statistics (1981), doi:10.1002/0471725250, section 7.6). Two forms of it are used:

- Weights that are the same for all residuals of an output in an experiment mean 1 / sigma^2. Then
  psi' = w. With s^2 = r'Wr / (n - k), the covariance is the usual s^2 (J'WJ)^-1. This applies to
  the sum of squares, and to the Gaussian likelihood with estimated sigmas, for which s^2 is near 1.
- Weights that differ between residuals are those of a robust cost. A large residual has a small
  weight because it is large, not because its measurement is less accurate. So the usual form would
  be too narrow. psi' and psi^2 are then averaged over the residuals of each output, with Huber's
  correction 1 + (k / n) var(psi') / mean(psi')^2 for few residuals. This is the sandwich under the
  assumption that all residuals of an output have the same scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.linear_map import LARGEST_RESIDUAL_WEIGHT
from cluster_est.methods.method import Solution
from cluster_est.problem.costs import Cost
from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty.covariance import accuracy
from cluster_est.uncertainty.covariance.local_uncertainty import (
    UndeterminedDirection,
    direction,
    sparse_basis,
)
from cluster_est.uncertainty.covariance.noise_covariance import (
    EstimateCovariance,
    WeightedResiduals,
    white_covariance,
)
from cluster_est.uncertainty.covariance.normal_equations import (
    BlockFactors,
    ErrorLimits,
    UndeterminedCombination,
    UnknownLayout,
    blocks,
    factorise,
    jacobian_blocks,
    null_space,
)
from workers.messages import FloatArray, IntArray

EQUAL = 1e-9
PSI_STEP = 1e-4
"""Step to differentiate psi, over the median absolute residual."""


@dataclass(frozen=True)
class ResidualScatter:
    """The scatter of the residuals after k directions were fitted.

    The covariance is `variance` times that of the factors with `spread`.

    Attributes
    ----------
    variance
        The variance s^2, which is also the scale for increases of the cost.
    degrees
        The degrees of freedom n - k.
    spread : (residuals,) or None
        Relative variances of the residuals; None if all are 1.
    """

    variance: float
    degrees: int
    spread: FloatArray | None


NO_RESIDUALS_LEFT = "the residuals of an output are 0, so its noise cannot be estimated from them"


@dataclass(frozen=True)
class RowWeighting:
    """Row weights of the Jacobian at a solution.

    Attributes
    ----------
    factor : (residuals,)
        Factor of each row of the Jacobian: sqrt(w), or the square root of the mean psi'.
    robust
        Whether the weights are those of a robust cost.
    problem
        The reason why there is no covariance; "" if there is one.
    squares, psi_derivatives, groups : (residuals,)
        w r^2; for a robust cost psi^2, psi' and the output of each residual.
    residuals : (residuals,)
        sqrt(w) r, or psi over `factor`; the errors of the estimates follow from them.
    priors : (residuals,)
        Whether each residual is that of a prior. Its standard deviation is 1, even if the
        measurements scatter by more than their sigmas. None without priors.
    hidden
        Number of values below a detection limit, whose residuals have no scatter. If there are any,
        the noise is assumed to be the declared one.
    """

    factor: FloatArray
    robust: bool = False
    problem: str = ""
    squares: FloatArray | None = None
    psi_derivatives: FloatArray | None = None
    groups: IntArray | None = None
    residuals: FloatArray | None = None
    priors: npt.NDArray[np.bool_] | None = None
    hidden: int = 0

    def scatter(self, rank: int) -> ResidualScatter:
        """Return the scatter of the residuals after `rank` directions were fitted."""
        count = len(self.factor)
        degrees = count - rank
        squares = self.squares
        if self.problem or degrees <= 0 or squares is None:
            return ResidualScatter(np.nan, degrees, None)
        if self.hidden:
            return ResidualScatter(1.0, degrees, None)
        if self.groups is None or self.psi_derivatives is None:
            variance = float(np.add.reduce(squares)) / degrees
            if self.priors is None or not variance > 0.0:
                return ResidualScatter(variance, degrees, None)
            return ResidualScatter(variance, degrees, np.where(self.priors, 1.0 / variance, 1.0))
        spread = np.empty(count)
        for group in np.unique(self.groups):
            inside = self.groups == group
            psi_d = self.psi_derivatives[inside]
            correction = 1.0 + rank / count * float(psi_d.var()) / float(psi_d.mean()) ** 2
            scale = float(squares[inside].mean()) * count / degrees
            spread[inside] = correction**2 * scale / float(psi_d.mean())
        mean = float(spread.mean())
        constant = np.ptp(spread) <= EQUAL * mean
        return ResidualScatter(mean, degrees, None if constant else spread / mean)


def row_weighting(
    cost: Cost, residuals: FloatArray, outputs: IntArray, rows: Sequence[slice]
) -> RowWeighting:
    """Return row weights at a solution.

    Parameters
    ----------
    cost
        The minimised cost.
    residuals, outputs
        Residuals at the solution, and the output of each; no outputs if they are not known.
    rows
        Rows of each experiment's residuals.
    """
    count = len(residuals)
    weights = cost.weights(residuals, outputs)
    if weights is None or not np.isfinite(weights).all():
        return RowWeighting(np.ones(count), problem=f"the cost {cost.name!r} has no weights")
    if weights.max(initial=0.0) > LARGEST_RESIDUAL_WEIGHT:
        return RowWeighting(np.ones(count), problem=NO_RESIDUALS_LEFT)
    groups = outputs if len(outputs) == count else np.zeros(count, np.int64)
    if _constant_in_groups(weights, groups, rows):
        factor = np.sqrt(weights)
        return RowWeighting(factor, squares=weights * residuals**2, residuals=factor * residuals)
    psi_derivatives = _psi_derivatives(cost, residuals, outputs)
    means = np.empty(count)
    for group in np.unique(groups):
        means[groups == group] = psi_derivatives[groups == group].mean()
    if not (means > 0.0).all():
        reason = (
            "most residuals are outliers for this cost, because the scale of the cost is too small"
        )
        return RowWeighting(np.ones(count), True, problem=reason)
    psi = weights * residuals
    factor = np.sqrt(means)
    return RowWeighting(factor, True, "", psi**2, psi_derivatives, groups, psi / factor)


def _constant_in_groups(weights: FloatArray, groups: IntArray, rows: Sequence[slice]) -> bool:
    """Return whether the weights are the same within each output of each experiment."""
    for row in rows:
        for group in np.unique(groups[row]):
            inside = weights[row][groups[row] == group]
            if np.ptp(inside) > EQUAL * inside.max():
                return False
    return True


def _psi_derivatives(cost: Cost, residuals: FloatArray, outputs: IntArray) -> FloatArray:
    """Return d psi / d r from central differences.

    The steps have alternating signs, so a scale that the cost computes from the residuals does not
    change.
    """
    step = PSI_STEP * (float(np.median(np.abs(residuals))) or 1.0)
    steps = np.where(np.arange(len(residuals)) % 2 == 0, step, -step)
    r_plus, r_minus = residuals + steps, residuals - steps
    w_plus, w_minus = cost.weights(r_plus, outputs), cost.weights(r_minus, outputs)
    if w_plus is None or w_minus is None:
        return np.full(len(residuals), np.nan)
    return (w_plus * r_plus - w_minus * r_minus) / (r_plus - r_minus)


WEAK = 1e-6
"""Largest ratio of directions that are reported as hardly determined."""
ROUNDING_OF_DIRECTION = 1e-6
"""Component of an unknown in a direction below which it is rounding error."""
ORDINAL = (
    "for an ordinal output, only the order of the values is known, so the distances to the limits "
    "of the categories do not reveal its noise"
)


@dataclass(frozen=True)
class ScaledJacobian:
    """A factorised Jacobian in scaled unknowns, x times `scale`.

    Attributes
    ----------
    layout, unbounded_layout
        The free unknowns, shared and local, with and without regard to bounds.
    scale : (unknowns,)
        Norms of the weighted columns; 1 for columns of zeros.
    coordinates : (shared, coordinates)
        A basis of the shared unknowns' changes that satisfy the active constraints.
    factors
        The eliminated blocks.
    covariance
        Covariance of the estimates for white noise.
    uniform
        Covariance of the estimates if priors scattered like the measurements; None without priors.
    residuals
        Weighted residuals for other noise models.
    combinations
        Directions that the data do not determine, or hardly, without regard to bounds. A search may
        follow such a direction up to a bound, which does not determine it either.
    undetermined : (directions, unknowns)
        Directions that the data do not determine.
    tolerance
        Size of the components of `undetermined` that are errors of the derivatives.
    """

    layout: UnknownLayout
    unbounded_layout: UnknownLayout
    weighting: RowWeighting
    scale: FloatArray
    coordinates: FloatArray
    factors: BlockFactors
    covariance: EstimateCovariance
    uniform: EstimateCovariance | None
    residuals: WeightedResiduals
    scatter: ResidualScatter
    combinations: tuple[UndeterminedCombination, ...]
    undetermined: FloatArray
    tolerance: float


def factorised_jacobian(
    space: SearchSpace,
    solution: Solution,
    layouts: tuple[UnknownLayout, UnknownLayout],
    *,
    measured_step: float | FloatArray,
    weak: float = WEAK,
) -> ScaledJacobian:
    """Weight, scale and factorise the Jacobian of a solution.

    Parameters
    ----------
    space, solution
        The search space, and the solution with a Jacobian.
    layouts
        `ScaledJacobian.layout` and `ScaledJacobian.unbounded_layout`.
    measured_step
        The relative step with which undetermined directions were measured, for each unknown or for
        all; 0 if they were not measured.
    weak
        Largest ratio of a hardly determined direction.
    """
    jacobian = jacobian_blocks(space, solution)
    assert jacobian is not None
    layout, unbounded = layouts
    weighting, rows = _weighting(space, solution, jacobian.row_count)
    matrix, limits, scale = _scaled(space, solution, jacobian, weighting, measured_step)
    coordinates = _coordinates(layout, scale)
    factors = _factorise(matrix, layout, coordinates, limits, weak)
    combinations = factors.combinations
    if any(layout.active_bounds):
        basis = _coordinates(unbounded, scale)
        combinations = _factorise(matrix, unbounded, basis, limits, weak).combinations
    scatter = weighting.scatter(factors.rank + space.free_observations)
    spread = None if scatter.spread is None else [scatter.spread[row] for row in rows]
    chosen = [c for c in combinations if c.undetermined]
    tolerance = max([ROUNDING_OF_DIRECTION, *(c.limit for c in chosen)])
    return ScaledJacobian(
        layout=layout,
        unbounded_layout=unbounded,
        weighting=weighting,
        scale=scale,
        coordinates=coordinates,
        factors=factors,
        covariance=white_covariance(factors, spread, scatter.variance, scatter.degrees),
        uniform=None
        if weighting.priors is None
        else white_covariance(factors, None, scatter.variance, scatter.degrees),
        residuals=_weighted_residuals(space, weighting, rows),
        scatter=scatter,
        combinations=combinations,
        undetermined=sparse_basis(vectors(space, unbounded, chosen), tolerance),
        tolerance=tolerance,
    )


def _scaled(
    space: SearchSpace,
    solution: Solution,
    jacobian: BlockMatrix,
    weighting: RowWeighting,
    measured_step: float | FloatArray,
) -> tuple[BlockMatrix, FloatArray, FloatArray]:
    """Return the weighted, scaled Jacobian, the relative errors of its columns, and the scale."""
    matrix = jacobian.scaled_rows(weighting.factor)
    norms = matrix.norms()
    scale = np.where(norms > 0.0, norms, 1.0)
    limits = _limits(space, solution, weighting, norms, measured_step)
    noise = limits >= 1.0  # such columns would disturb columns of determined unknowns
    limits[noise] = accuracy.ROUNDING_OF_DERIVATIVES
    return matrix.divided_columns(np.where(noise, np.inf, scale)), limits, scale


def _coordinates(layout: UnknownLayout, scale: FloatArray) -> FloatArray:
    """Return a basis of the shared unknowns' changes that satisfy the active constraints."""
    return null_space(layout.constraint_jacobian / scale[layout.shared])


def _factorise(
    matrix: BlockMatrix,
    layout: UnknownLayout,
    coordinates: FloatArray,
    limits: FloatArray,
    weak: float,
) -> BlockFactors:
    """Factorise a scaled Jacobian in coordinates of the shared unknowns."""
    parts = blocks(matrix, layout, coordinates)
    local = tuple(limits[each] for each in layout.local)
    return factorise(parts, ErrorLimits(limits[layout.shared], local, coordinates), weak)


def directions(
    space: SearchSpace, x: FloatArray, system: ScaledJacobian
) -> tuple[UndeterminedDirection, ...]:
    """Return the directions that the data do not determine, then the hardly determined ones."""
    undetermined = [c for c in system.combinations if c.undetermined]
    weak = [c for c in system.combinations if not c.undetermined]
    ratio = max((c.ratio for c in undetermined), default=0.0)
    limit = max((c.limit for c in undetermined), default=0.0)
    moves = system.undetermined / system.scale
    moves = moves[np.isfinite(moves).all(axis=1) & moves.any(axis=1)]
    found = [direction(space, x, move, ratio, limit, undetermined=True) for move in moves]
    for combination in weak:
        (move,) = vectors(space, system.unbounded_layout, [combination]) / system.scale
        ratio, limit = combination.ratio, combination.limit
        found.append(direction(space, x, move, ratio, limit, undetermined=False))
    return tuple(found)


def vectors(
    space: SearchSpace, layout: UnknownLayout, combinations: Sequence[UndeterminedCombination]
) -> FloatArray:
    """Return combinations in the order of the space's unknowns: (combinations, unknowns)."""
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
    """Return row weights, and the rows of each experiment."""
    if solution.at is not None:
        rows, cost = solution.at.rows, space.problem.cost
        weighting = row_weighting(cost, solution.at.residuals, space.outputs, rows)
        if space.priors:
            weighting = replace(weighting, priors=space.priors.among(rows))
        if space.has_ordinal_values:
            weighting = replace(weighting, problem=ORDINAL)
        return replace(weighting, hidden=space.hidden_values), rows
    # for a sum of squares, its value suffices
    squares = np.full(count, solution.cost / max(count, 1))
    problem = ORDINAL if space.has_ordinal_values else ""
    return RowWeighting(np.ones(count), problem=problem, squares=squares), list(space.rows)


def _weighted_residuals(
    space: SearchSpace, weighting: RowWeighting, rows: Sequence[slice]
) -> WeightedResiduals:
    """Return the residuals with the weights of the Jacobian; none if they are not known."""
    values = np.zeros(0) if weighting.residuals is None else weighting.residuals
    outputs = space.outputs if len(space.outputs) == len(values) else np.zeros(len(values), int)
    priors = np.zeros(len(values), bool) if weighting.priors is None else weighting.priors
    return WeightedResiduals(values, outputs, tuple(rows), priors)


def _limits(
    space: SearchSpace,
    solution: Solution,
    weighting: RowWeighting,
    norms: FloatArray,
    measured_step: float | FloatArray,
) -> FloatArray:
    """Return the relative error of each column."""
    x = solution.x
    sensitivity = norms * accuracy.relative_sizes(space, x)
    factor = weighting.factor
    measured = accuracy.output_norm(
        space, factor if weighting.priors is None else factor[~weighting.priors]
    )
    outputs = max(measured, float(sensitivity.max(initial=0.0)))
    errors = accuracy.column_errors(space, x, sensitivity, outputs, solution.difference_steps)
    steps = np.broadcast_to(measured_step, errors.shape)
    sharper = accuracy.measured_errors(space, sensitivity, outputs, np.where(steps > 0, steps, 1.0))
    return np.where(steps > 0.0, sharper, errors)
