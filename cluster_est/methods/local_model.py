"""What a least-squares search knows around a point: how the cost is expected to change.

A search is the same with and without constraints; they differ in what a step is, and in what it is
to lower. Both stand here as one contract, with the model for bounds alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Evaluation
from cluster_est.methods.bounded_step import StepSolver
from cluster_est.methods.differences import Jacobian
from cluster_est.space import Space
from workers.messages import FloatArray

LONGEST_STEP = 10.0
"""How many times its own size an unknown may change in one step.

A longer one can lead to where nothing depends on an unknown any more, and there is no way back.
"""


@dataclass(frozen=True)
class Weighted:
    """Residuals and Jacobian times the square roots of the cost's weights, at one point.

    With weights w the gradient of the cost is 2 J'r of these, and |J p + r|^2 has the slope of the
    cost at p = 0.

    Attributes
    ----------
    roots : (residuals,)
        Square roots of the weights.
    residuals : (residuals,)
    matrix : (residuals, unknowns)
    squares
        Sum of the squares of `residuals`, to which tolerances are relative: the cost itself may be
        zero or negative.
    """

    roots: FloatArray = field(repr=False)
    residuals: FloatArray = field(repr=False)
    matrix: FloatArray = field(repr=False)
    squares: float


def weighted(space: Space, at: Evaluation, derivatives: Jacobian) -> Weighted:
    """Residuals and Jacobian of an evaluation as the cost weights them."""
    residuals = at.residuals
    weights = space.problem.cost.weights(residuals, space.outputs)
    if weights is None:
        raise ProblemError(
            f"cost.name: must be one with weights for a least-squares method, but is "
            f'{space.problem.cost.name!r}; use method.name = "sqp" or another cost'
        )
    roots = np.sqrt(np.maximum(weights, 0.0))
    scaled = roots * residuals
    with np.errstate(over="ignore"):
        squares = float(np.add.reduce(scaled * scaled))
    return Weighted(roots, scaled, roots[:, None] * derivatives.matrix, squares)


def sizes(space: Space, x: FloatArray) -> FloatArray:
    """(unknowns,): how large each unknown is, to judge whether a step is short or long."""
    return np.maximum(np.abs(x), space.typical)


def longest_step(space: Space, x: FloatArray) -> FloatArray:
    """(unknowns,): how far each unknown may move; no limit where nothing tells its size."""
    unknown = (space.start == 0.0) & ~np.isfinite(space.upper - space.lower)
    return np.where(unknown, np.inf, LONGEST_STEP * sizes(space, x))


class LocalModel(ABC):
    """Steps from a point, and what they should gain.

    Attributes
    ----------
    squares
        Weighted sum of squares of the residuals at the point.
    optimality
        How far from a minimum; 0 at one.
    scale : (unknowns,)
        D, the diagonal by which damping is scaled.
    """

    squares: float
    optimality: float
    scale: FloatArray
    alike: ClassVar[float] = 0.0

    @abstractmethod
    def step(self, damping: float) -> FloatArray:
        """The step that minimises the model plus damping |D p|^2."""

    @abstractmethod
    def corrected(self, step: FloatArray, at: Evaluation, damping: float) -> FloatArray:
        """The same step, had the model known how residuals and constraints bend towards `at`.

        Parameters
        ----------
        step, at
            Of an earlier trial, and what came out of it.
        damping
            As in `step`.
        """

    @abstractmethod
    def gain(self, step: FloatArray) -> float:
        """By how much the model expects a step to lower the merit."""

    @abstractmethod
    def merit(self, at: Evaluation) -> float:
        """What a step must lower; infinite where a simulation failed."""


class BoundedModel(LocalModel):
    """A Gauss-Newton model within bounds; what is lowered is the cost."""

    def __init__(
        self, space: Space, x: FloatArray, seen: Weighted, scale: FloatArray
    ) -> None:
        room = longest_step(space, x)
        self._bounds = np.maximum(space.lower - x, -room), np.minimum(space.upper - x, room)
        self._seen = seen
        self.squares = seen.squares
        self.scale = np.where(scale > 0.0, scale, 1.0)
        self.optimality = _optimality(space, x, seen.matrix, seen.residuals)
        self._solver = StepSolver(seen.matrix, seen.residuals, self.scale, *self._bounds)

    def step(self, damping: float) -> FloatArray:
        return self._solver.step(damping)

    def corrected(self, step: FloatArray, at: Evaluation, damping: float) -> FloatArray:
        bent = self._seen.roots * at.residuals - self._seen.matrix @ step
        return StepSolver(self._seen.matrix, bent, self.scale, *self._bounds).step(damping)

    def gain(self, step: FloatArray) -> float:
        return self.squares - self._solver.predicted_cost(step)

    def merit(self, at: Evaluation) -> float:
        return at.cost if at.ok and not np.isnan(at.cost) else np.inf


def _optimality(space: Space, x: FloatArray, matrix: FloatArray, residuals: FloatArray) -> float:
    """Largest cosine between residuals and a column whose unknown can still move downhill."""
    gradient = matrix.T @ residuals
    norms = np.linalg.norm(matrix, axis=0) * np.linalg.norm(residuals)
    blocked = ((x <= space.lower) & (gradient > 0.0)) | ((x >= space.upper) & (gradient < 0.0))
    usable = ~blocked & (norms > 0.0)
    return float(np.max(np.abs(gradient[usable]) / norms[usable], initial=0.0))
