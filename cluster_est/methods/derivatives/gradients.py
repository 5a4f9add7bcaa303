"""The gradient of a cost of any kind, and of the constraints, by finite differences.

Where the cost gives weights w to the residuals r, its gradient 2 J'(w r) follows from the Jacobian:
exact but for the differences in J, and one point for each colour of unknowns. Differences of the
cost itself lose twice the digits near a minimum and need a point for each unknown, because a
coloured point mixes the changes of several.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import Evaluation, Points, Progress
from cluster_est.methods.derivatives.differences import (
    ResidualJacobian,
    Scheme,
    difference_steps,
    jacobian,
)
from cluster_est.methods.derivatives.sensitivities import JacobianProvider
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray


@dataclass(frozen=True)
class CostDerivatives:
    """First derivatives at a point.

    Attributes
    ----------
    gradient : (unknowns,)
        Of the cost; zero for frozen unknowns.
    constraints : (constraints, unknowns)
        Of `Evaluation.constraints`; zero in frozen columns, too.
    curvature : (unknowns, unknowns) or None
        2 J'WJ, the Gauss-Newton matrix of the cost, where it has weights.
    frozen : (unknowns,)
        Unknowns whose derivatives could not be computed, because a simulation failed or a
        constraint has no value close by.
    residuals
        The Jacobian of the residuals, where the cost has weights.
    """

    gradient: FloatArray
    constraints: FloatArray
    curvature: FloatArray | None
    frozen: npt.NDArray[np.bool_]
    residuals: ResidualJacobian | None = field(default=None, repr=False)


def derivatives(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
    slopes: JacobianProvider | None = None,
) -> Generator[Points, list[Evaluation], CostDerivatives]:
    """Ask, in one request, for all that the derivatives at `x` need.

    Parameters
    ----------
    space, x, at
        The point and its evaluation, which is `ok`.
    scheme
        "forward" costs one evaluation for each colour of unknowns, or for each unknown where the
        cost has no weights; "central" costs two.
    relative_step
        0 for the step that suits the solver.
    slopes
        How Jacobians are taken, in place of the last two.
    """
    residuals = at.residuals
    weights = space.problem.cost.weights(residuals, space.outputs)
    if weights is None:
        return (yield from _of_cost(space, x, at, scheme, relative_step, progress))
    if slopes is not None:
        found = yield from slopes.jacobian(space, x, at, progress)
    else:
        found = yield from jacobian(space, x, at, scheme, relative_step, progress)
    weighted = found.matrix * weights[:, None]
    gradient = 2.0 * np.add.reduce(weighted * residuals[:, None], axis=0)
    curvature = 2.0 * (found.matrix.T @ weighted)
    return _sound(CostDerivatives(gradient, found.constraints, curvature, found.frozen, found))


def _of_cost(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
) -> Generator[Points, list[Evaluation], CostDerivatives]:
    """Differences of the cost itself: a point for each unknown, or two."""
    steps = difference_steps(space, x, scheme, relative_step)
    ahead = x + np.diag(steps)
    behind = np.tile(x, (space.size, 1))
    if scheme == "forward":
        high = yield Points(ahead, "gradient", progress)
        low = [at] * space.size
    else:
        behind = np.clip(x - np.diag(steps), space.lower, space.upper)
        both = yield Points(np.vstack([ahead, behind]), "gradient_central", progress)
        high, low = both[: space.size], both[space.size :]
    widths = np.diagonal(ahead - behind)
    gradient = np.zeros(space.size)
    constraints = np.zeros((len(space.constraint_names), space.size))
    frozen = np.zeros(space.size, dtype=bool)
    for i, width in enumerate(widths.tolist()):
        slope = (high[i].cost - low[i].cost) / width if width != 0.0 else np.nan
        frozen[i] = not np.isfinite(slope)
        if not frozen[i]:
            gradient[i] = slope
            constraints[:, i] = (high[i].constraints - low[i].constraints) / width
    own = space.parameter_constraint_slopes(x)
    constraints[: len(own)] = np.where(frozen, 0.0, own)
    return _sound(CostDerivatives(gradient, constraints, None, frozen))


def _sound(found: CostDerivatives) -> CostDerivatives:
    """Freeze unknowns with which a constraint loses its value."""
    lost = ~np.isfinite(found.constraints).all(axis=0)
    if not lost.any():
        return found
    return replace(
        found,
        gradient=np.where(lost, 0.0, found.gradient),
        constraints=np.where(lost, 0.0, found.constraints),
        frozen=found.frozen | lost,
    )
