"""The local model of an SQP around its current point, and the best step from there.

The cost is modelled to second order, the constraints to first. The step minimises this model of the
cost plus a penalty on violated constraints, within the bounds and a box around the point, the trust
region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.derivatives.gradients import CostDerivatives
from cluster_est.methods.evaluation_status import is_defined
from cluster_est.methods.sqp.constraint_linearisations import (
    ConstraintLinearisation,
    LinearisationHistory,
    is_jump,
)
from cluster_est.methods.sqp.hessian import Hessian, HessianApproximations
from cluster_est.methods.sqp.penalty import PenaltyParameter
from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem, penalised_step
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray

NEAREST_POINT_CURVATURE = 1e-4
"""The curvature that takes the place of the cost's where nothing is to be minimised: of all points
that satisfy the constraints, the nearest."""


@dataclass(frozen=True)
class ModelStep:
    """A step, and the model's prediction for it.

    Attributes
    ----------
    vector : (n,)
        The change of the point.
    model
        The model that it minimises.
    multipliers : (constraints,)
        Of the constraints in the model.
    predicted_reduction
        Of the merit.
    """

    vector: FloatArray
    model: QuadraticSubproblem
    multipliers: FloatArray
    predicted_reduction: float


class SqpLocalModel:
    """The local model of one iterate after the other; `move_to` comes before all else.

    Parameters
    ----------
    space
        The space that is searched.
    hessian
        The approximation of the Hessian; see `Sqp`.
    feasibility_only
        True if there is nothing to minimise.
    """

    def __init__(self, space: SearchSpace, hessian: Hessian, feasibility_only: bool) -> None:
        self._space, self._feasibility_only = space, feasibility_only
        self._equality = space.equality
        self._hessian = HessianApproximations(hessian)
        self._history = LinearisationHistory(self._equality, 2 * space.size)
        self._sizes = space.typical
        nowhere = np.full(space.size, np.nan)
        self._linearisation = ConstraintLinearisation(
            nowhere, np.zeros(0), np.zeros((0, space.size))
        )
        self._at: Evaluation
        self.derivatives: CostDerivatives
        self.along_walls = False
        """Whether steps stay clear of sides on which simulations fail."""
        self.penalty = PenaltyParameter(self._equality)

    def move_to(
        self, x: FloatArray, at: Evaluation, derivatives: CostDerivatives, multipliers: FloatArray
    ) -> None:
        """Build the model around a point; `multipliers` are those of the step to it."""
        if not self.is_at(x):
            self._history.add(self._linearisation)
        self._linearisation = ConstraintLinearisation(
            x, at.constraints, derivatives.constraint_jacobian
        )
        self._at, self.derivatives = at, derivatives
        self.along_walls = False
        self._sizes = np.where(
            self._space.logarithmic, 1.0, np.maximum(np.abs(x), self._space.typical)
        )
        self._hessian.update(x, derivatives, multipliers, self._sizes)
        self.penalty.initialise(at.cost, float(np.abs(self._sizes * derivatives.gradient).max()))

    def is_at(self, x: FloatArray) -> bool:
        """Return whether x is the current point."""
        return np.array_equal(self._linearisation.x, x)

    def step(self, radius: float) -> ModelStep:
        """Return the best step within a trust region; may raise the penalty."""
        model = self._model(radius)
        vector, multipliers = self.penalty.step(model, *self._step_bounds(radius), self._sizes)
        reduction = self.penalty.predicted_reduction(model, self._at, vector)
        return ModelStep(vector, model, multipliers, reduction)

    def corrected(self, step: ModelStep, after: Evaluation, radius: float) -> FloatArray:
        """Return the step with the same Jacobian but the constraints' values `after` the trial.

        The second-order correction for curved constraints, which a step along their tangents
        violates (R. Fletcher, section 14.4, as in trust_region.py).
        """
        values = step.model.values.copy()
        values[: len(self._equality)] = (
            after.constraints - self.derivatives.constraint_jacobian @ step.vector
        )
        model = replace(step.model, values=values)
        return penalised_step(model, self.penalty.value, *self._step_bounds(radius))[0]

    def compare(self, step: ModelStep, after: Evaluation) -> None:
        """Compare the Lagrangian's change along a step with the predictions of both Hessians."""
        if not is_defined(after):
            return
        linear = self._at.constraints + self.derivatives.constraint_jacobian @ step.vector
        curved = float(np.add.reduce(step.multipliers * (after.constraints - linear)))
        linear_change = float(self.derivatives.gradient @ step.vector)
        self._hessian.compare(step.vector, linear_change, after.cost - self._at.cost + curved)

    def has_kink(self, step: ModelStep, after: Evaluation) -> bool:
        """Return whether a kink of a constraint may explain the violation after a step.

        A discontinuous constraint has no linearisation that helps.
        """
        jump = is_jump(self._linearisation, step.vector, after.constraints)
        return not (self._equality.all() or jump)

    def add_linearisation(
        self, x: FloatArray, at: Evaluation, derivatives: CostDerivatives
    ) -> None:
        """Add the linearisation of the constraints at another point; from now on all count."""
        self._history.active = True
        if not derivatives.frozen.any():
            self._history.add(
                ConstraintLinearisation(x, at.constraints, derivatives.constraint_jacobian)
            )

    def length(self, vector: FloatArray) -> float:
        """Return the length of a step: the largest change of an unknown over its size."""
        return float(np.max(np.abs(vector / self._sizes)))

    def _model(self, radius: float) -> QuadraticSubproblem:
        hessian = self._hessian.matrix
        if self._feasibility_only:
            hessian = np.diag(NEAREST_POINT_CURVATURE / self._sizes**2)
        model = QuadraticSubproblem(
            self.derivatives.gradient,
            hessian,
            self._linearisation.values,
            self._linearisation.jacobian,
            np.arange(len(self._equality), dtype=np.intp),
            self._equality,
        )
        return self._history.extend(model, self._linearisation.x, radius * self._sizes)

    def _step_bounds(self, radius: float) -> tuple[FloatArray, FloatArray]:
        """Return bounds of the step by the trust region and the bounds; 0 for frozen unknowns."""
        radii = np.where(self.derivatives.frozen, 0.0, radius * self._sizes)
        lower = np.maximum(-radii, self._space.lower - self._linearisation.x)
        upper = np.minimum(radii, self._space.upper - self._linearisation.x)
        walls = self.derivatives.walls
        if not self.along_walls or not len(walls):
            return lower, upper
        return np.where(walls < 0, 0.0, lower), np.where(walls > 0, 0.0, upper)
