"""What a least-squares search knows around a point: steps, and what they should gain."""

from __future__ import annotations

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Evaluation
from cluster_est.methods.derivatives.differences import ResidualJacobian
from cluster_est.methods.least_squares.linear_model import LinearMap, linear_map
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

LONGEST_STEP = 10.0
"""How many times its own size an unknown may change in one step.

A longer one can lead to where nothing depends on an unknown any more, and there is no way back.
"""


class LocalModel:
    """The Gauss-Newton model of a cost around a point, within bounds.

    With the cost's weights w the gradient of the cost is 2 J'r of sqrt(w) J and sqrt(w) r, so that
    |J p + r|^2 of these has the slope of the cost at p = 0, and its steps go downhill.

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
        Largest cosine between the residuals and a column whose unknown can still move downhill.
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
        self._map = linear_map(derivatives, self._roots)
        with np.errstate(over="ignore"):
            self.squares = float(np.add.reduce(self._residuals * self._residuals))
        norms = self._map.norms()
        self.scale = np.maximum(largest, norms)
        self.optimality = _optimality(space, x, self._map, norms, self._residuals)
        room = _longest_step(space, x)
        self._bounds = np.maximum(space.lower - x, -room), np.minimum(space.upper - x, room)
        self._damped = np.where(self.scale > 0.0, self.scale, 1.0)
        self._solver = self._map.solver(self._residuals, self._damped, *self._bounds)

    def step(self, damping: float) -> FloatArray:
        """The step p that minimises the model plus damping |D p|^2."""
        return self._solver.step(damping)

    def corrected(self, step: FloatArray, at: Evaluation, damping: float) -> FloatArray:
        """The same step, had the model known how the residuals bend towards `at`, its end."""
        bent = self._roots * at.residuals - self._map.product(step)
        return self._map.solver(bent, self._damped, *self._bounds).step(damping)

    def gain(self, step: FloatArray) -> float:
        """By how much the model expects a step to lower the cost."""
        return self.squares - self._solver.predicted_cost(step)

    def length(self, step: FloatArray) -> float:
        """|D p|, the length of a step whatever the units of the unknowns."""
        return float(np.linalg.norm(self._damped * step))

    def product(self, one: FloatArray, other: FloatArray) -> float:
        """The inner product of steps whose norm is `length`."""
        return float(np.add.reduce((self._damped * one) * (self._damped * other)))


def sizes(space: SearchSpace, x: FloatArray) -> FloatArray:
    """(unknowns,): how large each unknown is, to judge whether a step is short or long."""
    return np.maximum(np.abs(x), space.typical)


def _longest_step(space: SearchSpace, x: FloatArray) -> FloatArray:
    """(unknowns,): how far each unknown may move; no limit where nothing tells its size."""
    unknown = (space.start == 0.0) & ~np.isfinite(space.upper - space.lower)
    return np.where(unknown, np.inf, LONGEST_STEP * sizes(space, x))


def _weights(space: SearchSpace, at: Evaluation) -> FloatArray:
    weights = space.problem.cost.weights(at.residuals, space.outputs)
    if weights is None:
        raise ProblemError(
            f"cost.name: must be one with weights for a least-squares method, but is "
            f'{space.problem.cost.name!r}; use method.name = "sqp" or another cost'
        )
    return np.maximum(weights, 0.0)


def _optimality(
    space: SearchSpace, x: FloatArray, map_: LinearMap, norms: FloatArray, residuals: FloatArray
) -> float:
    gradient = map_.transposed_product(residuals)
    norms = norms * np.linalg.norm(residuals)
    blocked = ((x <= space.lower) & (gradient > 0.0)) | ((x >= space.upper) & (gradient < 0.0))
    usable = ~blocked & (norms > 0.0)
    return float(np.max(np.abs(gradient[usable]) / norms[usable], initial=0.0))
