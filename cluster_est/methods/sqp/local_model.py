"""What a sequential method knows around its point, and the best step from there.

The cost is known to second order, the constraints to first. The step minimises this model of the
cost plus a penalty on violated constraints, within the bounds and a box around the point, the trust
region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.derivatives.gradients import CostDerivatives
from cluster_est.methods.sqp.evaluation_cache import usable
from cluster_est.methods.sqp.hessian import CurvatureHistory, Hessian
from cluster_est.methods.sqp.linear_pieces import (
    ConstraintLinearisation,
    LinearisationHistory,
    is_jump,
)
from cluster_est.methods.sqp.penalty import PenaltyParameter
from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem, penalised_step
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

ALMOST_FLAT = 1e-4
"""The curvature that takes the place of the cost's where nothing is to be minimised: of all points
that satisfy the constraints, the nearest."""


@dataclass(frozen=True)
class ModelStep:
    """A step, and what the model expects of it.

    Attributes
    ----------
    vector : (n,)
        What is added to the point.
    model
        The model that it minimises.
    multipliers : (constraints,)
        The model's: what an easier constraint would save.
    promised
        The decrease of the merit, if the model is right.
    """

    vector: FloatArray
    model: QuadraticSubproblem
    multipliers: FloatArray
    promised: float


class SqpLocalModel:
    """Of one point after the other: `arrive` comes first, and again after each move.

    Parameters
    ----------
    space
        Where to search.
    hessian
        Which curvature of the cost to take; see `Sqp`.
    feasibility_only
        Whether there is nothing to minimise.
    """

    def __init__(self, space: SearchSpace, hessian: Hessian, feasibility_only: bool) -> None:
        self._space, self._feasibility_only = space, feasibility_only
        self._equality = space.equality
        self._logarithmic = np.array([unknown.log for unknown in space.unknowns], dtype=bool)
        self._curvature = CurvatureHistory(hessian)
        self._pieces = LinearisationHistory(self._equality, 2 * space.size)
        self._sizes = space.typical
        nowhere = np.full(space.size, np.nan)
        self._here = ConstraintLinearisation(nowhere, np.zeros(0), np.zeros((0, space.size)))
        self._at: Evaluation
        self.slopes: CostDerivatives
        self.penalty = PenaltyParameter(self._equality)

    def arrive(
        self, x: FloatArray, at: Evaluation, slopes: CostDerivatives, multipliers: FloatArray
    ) -> None:
        """Take over what is known of a point; `multipliers` are those of the step to it."""
        if not self.is_known(x):
            self._pieces.add(self._here)
        self._here = ConstraintLinearisation(x, at.constraints, slopes.constraints)
        self._at, self.slopes = at, slopes
        self._sizes = np.where(self._logarithmic, 1.0, np.maximum(np.abs(x), self._space.typical))
        self._curvature.at(x, slopes, multipliers, self._sizes)
        self.penalty.begin(at.cost, float(np.abs(self._sizes * slopes.gradient).max()))

    def is_known(self, x: FloatArray) -> bool:
        """Whether x is the point where it arrived last."""
        return np.array_equal(self._here.x, x)

    def step(self, radius: float) -> ModelStep:
        """The best step within a trust region; may raise the penalty."""
        model = self._model(radius)
        vector, multipliers = self.penalty.step(model, *self._room(radius), self._sizes)
        promised = self.penalty.promised(model, self._at, vector)
        return ModelStep(vector, model, multipliers, promised)

    def corrected(self, step: ModelStep, after: Evaluation, radius: float) -> FloatArray:
        """The step with the same slopes, but with the constraints' values `after` the first try.

        It makes up for bent constraints, which leave a step along their tangents too far out: the
        second-order correction of R. Fletcher (section 14.4, as in sequential.py).
        """
        values = step.model.values.copy()
        values[: len(self._equality)] = after.constraints - self.slopes.constraints @ step.vector
        model = replace(step.model, values=values)
        return penalised_step(model, self.penalty.value, *self._room(radius))[0]

    def learn(self, step: ModelStep, after: Evaluation) -> None:
        """Compare what a step did to the Lagrangian with what each guess of the curvature said."""
        if not usable(after):
            return
        linear = self._at.constraints + self.slopes.constraints @ step.vector
        bent = float(np.add.reduce(step.multipliers * (after.constraints - linear)))
        along = float(self.slopes.gradient @ step.vector)
        self._curvature.learn(step.vector, along, after.cost - self._at.cost + bent)

    def kinked(self, step: ModelStep, after: Evaluation) -> bool:
        """Whether a face of a constraint that is not seen from here explains what spoiled a step.

        A constraint that jumps has no such face.
        """
        jump = is_jump(self._here, step.vector, after.constraints)
        return not (self._equality.all() or jump)

    def see_face(self, x: FloatArray, at: Evaluation, slopes: CostDerivatives) -> None:
        """Let the constraints as they are seen from another point count too, from now on."""
        self._pieces.active = True
        if not slopes.frozen.any():
            self._pieces.add(ConstraintLinearisation(x, at.constraints, slopes.constraints))

    def length(self, vector: FloatArray) -> float:
        """Of a step: the largest part of an unknown's size by which it moves one."""
        return float(np.max(np.abs(vector / self._sizes)))

    def _model(self, radius: float) -> QuadraticSubproblem:
        hessian = self._curvature.matrix
        if self._feasibility_only:
            hessian = np.diag(ALMOST_FLAT / self._sizes**2)
        model = QuadraticSubproblem(
            self.slopes.gradient,
            hessian,
            self._here.values,
            self._here.slopes,
            np.arange(len(self._equality), dtype=np.intp),
            self._equality,
        )
        return self._pieces.extend(model, self._here.x, radius * self._sizes)

    def _room(self, radius: float) -> tuple[FloatArray, FloatArray]:
        """Of a step: the trust region and the bounds; none for frozen unknowns."""
        reach = np.where(self.slopes.frozen, 0.0, radius * self._sizes)
        lower = np.maximum(-reach, self._space.lower - self._here.x)
        return lower, np.minimum(reach, self._space.upper - self._here.x)
