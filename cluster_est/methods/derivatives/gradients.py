"""The gradient of a cost of any kind, and of the constraints, by finite differences.

Where the cost gives weights w to the residuals r, its gradient 2 J'(w r) follows from the Jacobian:
exact but for the differences in J, and one point for each colour of unknowns. Differences of the
cost itself lose twice the digits near a minimum and need a point for each unknown, because a
coloured point mixes the changes of several.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import Evaluation, Points, Progress
from cluster_est.methods.derivatives.differences import (
    PARTS,
    Neighbours,
    ResidualJacobian,
    Scheme,
    difference_steps,
    jacobian,
)
from cluster_est.methods.derivatives.sensitivities import JacobianProvider
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray


@dataclass(frozen=True)
class CostDerivatives:
    """First derivatives at a point.

    Attributes
    ----------
    gradient : (unknowns,)
        Of the cost; zero for frozen unknowns.
    constraint_jacobian : (constraints, unknowns)
        Of `Evaluation.constraints`; zero in frozen columns, too.
    gauss_newton : (unknowns, unknowns) or None
        2 J'WJ, the Gauss-Newton matrix of the cost, where it has weights.
    frozen : (unknowns,)
        Unknowns whose derivatives could not be computed, because a simulation failed or a
        constraint has no value close by.
    residual_jacobian
        The Jacobian of the residuals, where the cost has weights.
    walls
        See `ResidualJacobian.walls`.
    """

    gradient: FloatArray
    constraint_jacobian: FloatArray
    gauss_newton: FloatArray | None
    frozen: npt.NDArray[np.bool_]
    residual_jacobian: ResidualJacobian | None = field(default=None, repr=False)
    walls: FloatArray = field(default_factory=lambda: np.zeros(0))


def derivatives(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
    *,
    provider: JacobianProvider | None = None,
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
    progress
        For the table of iterations.
    provider
        The source of Jacobians, in place of `scheme` and `relative_step`.
    """
    residuals = at.residuals
    weights = space.problem.cost.weights(residuals, space.outputs)
    if weights is None:
        return (yield from _cost_differences(space, x, at, scheme, relative_step, progress))
    if provider is not None:
        jacobians = yield from provider.jacobian(space, x, at, progress)
    else:
        jacobians = yield from jacobian(space, x, at, scheme, relative_step, progress)
    return _from_jacobian(jacobians, residuals, weights)


def _from_jacobian(
    jacobians: ResidualJacobian, residuals: FloatArray, weights: FloatArray
) -> CostDerivatives:
    """Return 2 J'Wr and 2 J'WJ."""
    weighted = jacobians.matrix * weights[:, None]
    gradient = 2.0 * np.add.reduce(weighted * residuals[:, None], axis=0)
    gauss_newton = 2.0 * (jacobians.matrix.T @ weighted)
    return CostDerivatives(
        gradient,
        jacobians.constraint_jacobian,
        gauss_newton,
        jacobians.frozen,
        jacobians,
        jacobians.walls,
    )


def _cost_differences(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
) -> Generator[Points, list[Evaluation], CostDerivatives]:
    """Ask for differences of the cost itself: a point for each unknown, or two."""
    steps = difference_steps(space, x, scheme, relative_step)
    beside = Neighbours(x, scheme, [np.array([i], np.intp) for i in range(space.size)])
    purpose = "gradient" if scheme == "forward" else "gradient_central"
    here, wanted = _values(at), np.ones(space.size, dtype=bool)
    gradient = np.zeros(space.size)
    constraints = np.zeros((len(space.constraint_names), space.size))
    for parts in PARTS[scheme]:
        yield from beside.ask(space, steps, parts, wanted.copy(), purpose, progress)
        for i in np.flatnonzero(wanted).tolist():
            found = None if here is None else beside.derivative(i, here, _values)
            if found is not None and np.isfinite(found).all():
                wanted[i], gradient[i], constraints[:, i] = False, found[0], found[1:]
        if not wanted.any():
            break
    on_parameters = space.parameter_constraint_jacobian(x)
    constraints[: len(on_parameters)] = np.where(wanted, 0.0, on_parameters)
    return CostDerivatives(gradient, constraints, None, wanted, walls=beside.walls)


def _values(at: Evaluation) -> FloatArray | None:
    """Return the cost, and behind it the constraints; None if one of them has no value."""
    values = np.array([at.cost, *at.constraints])
    return values if np.isfinite(values).all() else None
