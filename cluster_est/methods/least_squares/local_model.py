"""The Gauss-Newton model around a point: its steps, and the reductions that it predicts.

Symbols: J the Jacobian, r the residuals, w the weights, D the scaling, p a step.
"""

from __future__ import annotations

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Evaluation
from cluster_est.methods.derivatives.differences import ResidualJacobian
from cluster_est.methods.least_squares.linear_map import LinearMap, linear_map
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray

LONGEST_STEP = 10.0
"""Largest change of an unknown in one step, over its own size.

A longer one can lead to where nothing depends on an unknown any more, and there is no way back.
"""
LARGEST_WEIGHT = 1e200
"""Of a residual; those of an output that is followed exactly would be infinite."""


class LocalModel:
    """The Gauss-Newton model of a cost around a point, within bounds.

    With the cost's weights w the gradient of the cost is 2 J'r of sqrt(w) J and sqrt(w) r, so that
    |J p + r|^2 of these has the gradient of the cost at p = 0, and its steps descend.

    Parameters
    ----------
    space, x, at, derivatives
        The point, its evaluation and its Jacobian.
    largest : (unknowns,)
        Largest column norms of the Jacobian so far.

    Attributes
    ----------
    squares
        Weighted sum of squares of the residuals, to which tolerances are relative: the cost itself
        may be zero or negative.
    scale : (unknowns,)
        `largest` with the column norms at this point; damping is scaled by it.
    optimality
        Largest cosine between the residuals and a column that is not held by a bound.
    """

    def __init__(
        self,
        space: SearchSpace,
        x: FloatArray,
        at: Evaluation,
        derivatives: ResidualJacobian,
        largest: FloatArray,
    ) -> None:
        self._roots = np.sqrt(_weights(space, at))
        self._residuals = self._roots * at.residuals
        self._jacobian = linear_map(derivatives, self._roots)
        with np.errstate(over="ignore"):
            self.squares = float(np.add.reduce(self._residuals * self._residuals))
        norms = self._jacobian.norms()
        self.scale = np.maximum(largest, norms)
        self.optimality = _optimality(space, x, self._jacobian, norms, self._residuals)
        longest = _longest_step(space, x)
        self._bounds = np.maximum(space.lower - x, -longest), np.minimum(space.upper - x, longest)
        self._diagonal = np.where(self.scale > 0.0, self.scale, 1.0)
        self._walls = derivatives.walls
        self._solver = self._jacobian.solver(self._residuals, self._diagonal, *self._bounds)

    def step(self, damping: float) -> FloatArray:
        """Return the step p that minimises the model plus damping |D p|^2."""
        return self._solver.step(damping)

    def along_walls(self, damping: float) -> FloatArray | None:
        """Return the step that stays clear of sides on which simulations fail, if there are any."""
        if not self._walls.any():
            return None
        lower, upper = self._bounds
        lower, upper = np.where(self._walls < 0, 0.0, lower), np.where(self._walls > 0, 0.0, upper)
        solver = self._jacobian.solver(self._residuals, self._diagonal, lower, upper)
        return solver.step(damping)

    def corrected(self, step: FloatArray, at: Evaluation, damping: float) -> FloatArray:
        """Return the step for residuals with the curvature that `at`, its end, shows."""
        curved = self._roots * at.residuals - self._jacobian.product(step)
        return self._jacobian.solver(curved, self._diagonal, *self._bounds).step(damping)

    def predicted_reduction(self, step: FloatArray) -> float:
        """Return the reduction of the cost that the model predicts for a step."""
        return self.squares - self._solver.predicted_cost(step)

    def norm(self, step: FloatArray) -> float:
        """Return |D p|, the length of a step whatever the units of the unknowns."""
        return float(np.linalg.norm(self._diagonal * step))

    def inner_product(self, one: FloatArray, other: FloatArray) -> float:
        """Return the inner product of two steps that goes with `norm`."""
        return float(np.add.reduce((self._diagonal * one) * (self._diagonal * other)))


def unknown_sizes(space: SearchSpace, x: FloatArray) -> FloatArray:
    """Return the size (unknowns,) of each unknown, to which the length of a step is relative."""
    return np.maximum(np.abs(x), space.typical)


def _longest_step(space: SearchSpace, x: FloatArray) -> FloatArray:
    """Return the largest change (unknowns,) of each; infinite where its size is not known."""
    unknown = (space.start == 0.0) & ~np.isfinite(space.upper - space.lower)
    return np.where(unknown, np.inf, LONGEST_STEP * unknown_sizes(space, x))


def _weights(space: SearchSpace, at: Evaluation) -> FloatArray:
    weights = space.problem.cost.weights(at.residuals, space.outputs)
    if weights is None:
        raise ProblemError(
            f"cost.name: must be one with weights for a least-squares method, but is "
            f'{space.problem.cost.name!r}; use method.name = "sqp" or another cost'
        )
    return np.clip(weights, 0.0, LARGEST_WEIGHT)


def _optimality(
    space: SearchSpace, x: FloatArray, jacobian: LinearMap, norms: FloatArray, residuals: FloatArray
) -> float:
    gradient = jacobian.transposed_product(residuals)
    norms = norms * np.linalg.norm(residuals)
    blocked = ((x <= space.lower) & (gradient > 0.0)) | ((x >= space.upper) & (gradient < 0.0))
    free = ~blocked & (norms > 0.0)
    return float(np.max(np.abs(gradient[free]) / norms[free], initial=0.0))
