"""The local model of an SQP around its current point, and the best step of the model.

The model of the cost is of second order, the model of the constraints of first order. The step
minimises the modelled cost plus a penalty on violated constraints. It stays within the bounds and
the trust region, a box around the point. The model consists of a Hessian, linearisations and a
penalty.

Hessian: there are two approximations, and neither needs further evaluations. The Gauss-Newton
matrix of the cost, 2 J'WJ, is accurate for small residuals and nearly linear constraints. The
quasi-Newton matrix starts from the Gauss-Newton matrix, if it exists, or from a multiple of the
identity. Updates add the change of the gradient along each of the last steps. They represent the
curvature due to large residuals and curved constraints. The approximation that predicted the last
steps better is used, as in J. E. Dennis, D. M. Gay, R. E. Welsch, ACM TOMS 7 (1981) 348-368,
doi:10.1145/355958.355965. The updates are damped BFGS updates, which keep the matrix positive
definite (J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed. (2006), procedure 18.2,
doi:10.1007/978-0-387-40065-5). Symbols as there: B is the matrix, s a step, y the change of the
Lagrangian's gradient along the step.

Linearisations: a constraint may be a maximum over time or over points. It has a kink at each change
of the maximising time or point, and the best point is often on the kink. A linearisation from one
side represents only one of the smooth functions. Steps along it violate the other function and are
rejected, so the trust region shrinks although the cost decreases along the kink. After such a
rejected step, the derivatives at its end are computed, too. They represent the other function. From
then on, the constraint is the maximum of its linearisations at this point and at recent points
nearby, like the cutting planes of bundle methods (K. C. Kiwiel, Methods of Descent for
Nondifferentiable Optimization, Lecture Notes in Mathematics 1133 (1985), doi:10.1007/BFb0074500).
Before the first kink only the linearisations at the point itself are used, because old
linearisations of smooth, curved constraints may exclude feasible points.

Penalty: the exact l1 merit function is merit = cost + penalty * sum of the violations. If the
penalty exceeds all multipliers, a solution of the constrained problem is a minimum of the merit. A
far larger penalty forces short steps along curved constraints, and too much weight on inaccurate
linearisations. So the penalty starts low. It grows tenfold while a step would not reduce the
linearised violation although the model allows a reduction. This is the weakest form of the steering
rule of R. H. Byrd, J. Nocedal, R. A. Waltz, Optim. Methods Softw. 23 (2008) 197-213,
doi:10.1080/10556780701394169.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import numpy.typing as npt

from cluster_est.methods.gradients import CostDerivatives
from cluster_est.methods.method import TOLERANCE, Evaluation, is_defined
from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem, penalised_step
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

Hessian = Literal["auto", "gauss_newton", "quasi_newton"]
QUASI_NEWTON_MEMORY = 30
"""Largest number of steps in the quasi-Newton updates."""
ERROR_DECAY = 0.5
"""Factor of the older prediction errors at each step."""
RIDGE = 1e-12


class HessianApproximations:
    """Two approximations of the Hessian, updated at each iterate, and their prediction errors."""

    def __init__(self, kind: Hessian) -> None:
        self._kind = kind
        self._iterates: list[tuple[FloatArray, CostDerivatives]] = []
        self._errors = np.zeros(2)
        self._matrices: list[FloatArray] = []

    @property
    def matrix(self) -> FloatArray:
        """The better approximation at the last point, (n, n), positive semidefinite."""
        return self._matrices[self._better]

    @property
    def _better(self) -> int:
        return int(len(self._matrices) > 1 and self._errors[1] < self._errors[0])

    def update(
        self,
        x: FloatArray,
        derivatives: CostDerivatives,
        multipliers: FloatArray,
        sizes: FloatArray,
    ) -> None:
        """Add an iterate.

        Parameters
        ----------
        x, derivatives
            The point and its derivatives.
        multipliers : (constraints,)
            Estimated multipliers of the Lagrangian.
        sizes : (n,)
            A noticeable change of each unknown.
        """
        self._iterates.append((x, derivatives))
        self._iterates = self._iterates[-QUASI_NEWTON_MEMORY - 1 :]
        pairs = self._pairs(multipliers)
        gauss_newton = derivatives.gauss_newton
        if gauss_newton is None:
            self._matrices = [_bfgs(_scaled_identity(pairs, derivatives.gradient, sizes), pairs)]
            return
        scale = np.trace(gauss_newton * np.outer(sizes, sizes))
        gauss_newton = gauss_newton + np.diag(RIDGE * max(float(scale), 1e-300) / sizes**2)
        both = [gauss_newton, _bfgs(gauss_newton, pairs)]
        chosen = {"auto": both, "gauss_newton": both[:1], "quasi_newton": both[1:]}
        self._matrices = chosen[self._kind]

    def compare(self, step: FloatArray, linear: float, actual: float) -> None:
        """Compare the predictions of both approximations with the change along a step.

        Parameters
        ----------
        step : (n,)
            Step from the last point.
        linear, actual
            Change of the Lagrangian predicted by its gradient alone, and its actual change.
        """
        if len(self._matrices) < 2 or not np.isfinite(actual):
            return
        predicted = [linear + 0.5 * float(step @ (matrix @ step)) for matrix in self._matrices]
        errors = np.abs(np.array(predicted) - actual)
        total = max(float(errors[0] + errors[1]), 1e-300)
        self._errors = ERROR_DECAY * self._errors + errors / total

    def _pairs(self, multipliers: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return the steps s, and the changes y of the Lagrangian's gradient along them.

        Steps between points with different frozen unknowns are left out.
        """
        pairs = []
        for (x, before), (x_after, after) in pairwise(self._iterates):
            if (before.frozen != after.frozen).any():
                continue
            bent = after.constraint_jacobian - before.constraint_jacobian
            pairs.append((x_after - x, after.gradient - before.gradient + bent.T @ multipliers))
        return pairs


def _scaled_identity(
    pairs: list[tuple[FloatArray, FloatArray]], gradient: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Return the identity in units of `sizes`, times y'y / s'y of the last step.

    Without a step of positive curvature the factor is the largest scaled gradient component.
    """
    curvature = max(float(np.abs(sizes * gradient).max(initial=0.0)), 1e-300)
    if pairs:
        s, y = pairs[-1][0] / sizes, pairs[-1][1] * sizes
        if s @ y > 0.0:
            curvature = float(y @ y / (s @ y))
    return np.diag(curvature / sizes**2)


def _bfgs(matrix: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return the matrix after damped BFGS updates, from the oldest step to the latest."""
    for s, y in pairs:
        b_s = matrix @ s
        s_b_s, s_y = float(s @ b_s), float(s @ y)
        if not s_b_s > 0.0:
            continue
        if s_y < 0.2 * s_b_s:
            theta = 0.8 * s_b_s / (s_b_s - s_y)
            y = theta * y + (1.0 - theta) * b_s
        matrix = matrix - np.outer(b_s, b_s) / s_b_s
        matrix = matrix + np.outer(y, y) / float(s @ y)
    return 0.5 * (matrix + matrix.T)


LARGEST_DISTANCE = 10.0
"""Largest distance of a usable linearisation, in trust radii."""
JUMP = 10.0
"""Excess of a constraint over its linearisation, relative to the linear change, that is a jump.

Linearisations of a discontinuous constraint are of no use."""


@dataclass(frozen=True)
class ConstraintLinearisation:
    """Constraints and their Jacobian at a point."""

    x: FloatArray
    values: FloatArray
    jacobian: FloatArray


class LinearisationHistory:
    """The latest linearisations of a search; it stores none until `active` is True."""

    def __init__(self, equality: npt.NDArray[np.bool_], most: int) -> None:
        self._inequalities = np.flatnonzero(~equality).astype(np.intp)
        self._most = most
        self._linearisations: list[ConstraintLinearisation] = []
        self.active = False

    def add(self, linearisation: ConstraintLinearisation) -> None:
        """Store a linearisation, and drop the oldest beyond the largest number."""
        if self.active and len(self._inequalities):
            self._linearisations = [*self._linearisations, linearisation][-self._most :]

    def extend(
        self, model: QuadraticSubproblem, x: FloatArray, radii: FloatArray
    ) -> QuadraticSubproblem:
        """Return the model around a point, with the linearisations at other points near it.

        The value of a constraint at `x` is the maximum of its smooth functions there. So a
        linearisation with a larger value at `x` is lowered to this value.

        Parameters
        ----------
        model
            The model, whose first rows are all constraints at `x`, in their order.
        x : (n,)
            The point.
        radii : (n,)
            The trust radius of each unknown.
        """
        rows = self._inequalities
        c = model.values[rows]
        near = [
            p for p in self._linearisations if np.max(np.abs(x - p.x) / radii) <= LARGEST_DISTANCE
        ]
        values = [np.minimum((p.values + p.jacobian @ (x - p.x))[rows], c) for p in near]
        count = len(near) * len(rows)
        return replace(
            model,
            values=np.concatenate([model.values, *values]),
            jacobian=np.vstack([model.jacobian, *(p.jacobian[rows] for p in near)]),
            constraint=np.append(model.constraint, np.tile(rows, len(near))),
            equality=np.append(model.equality, np.zeros(count, dtype=bool)),
        )


def is_jump(before: ConstraintLinearisation, step: FloatArray, after: FloatArray) -> bool:
    """Return whether a constraint increased more along a step than a kink explains."""
    excess = after - before.values - before.jacobian @ step
    allowed = JUMP * (np.abs(before.jacobian) @ np.abs(step))
    return bool((excess > allowed + 1e-12).any())


INITIAL = 0.01
"""The first penalty, relative to the cost or to its largest change by one unknown."""
LEAST_REDUCTION = 0.1
"""Least predicted reduction of the violation by a step, as a part of the possible reduction."""
MOST_INCREASES = 12
"""Largest number of tenfold increases for one step."""
NEGLIGIBLE_LINEAR_VIOLATION = 1e-3 * TOLERANCE


class PenaltyParameter:
    """The current penalty of the merit function; `equality` marks equality constraints."""

    def __init__(self, equality: npt.NDArray[np.bool_]) -> None:
        self._equality = equality
        self.value = 0.0

    def initialise(self, cost: float, steepest: float) -> None:
        """Choose the first penalty from the cost and its largest change by one unknown."""
        if self.value == 0.0:
            self.value = INITIAL * max(abs(cost), steepest) or 1.0

    def violations(self, at: Evaluation) -> float:
        """Return the sum of the violations."""
        values = at.constraints
        sizes = np.where(self._equality, np.abs(values), np.maximum(values, 0.0))
        return float(np.add.reduce(sizes))

    def merit(self, at: Evaluation) -> float:
        """Return the merit; infinite if the cost or a constraint is undefined."""
        return at.cost + self.value * self.violations(at) if is_defined(at) else np.inf

    def predicted_reduction(
        self, model: QuadraticSubproblem, at: Evaluation, step: FloatArray
    ) -> float:
        """Return the reduction of the merit that the model around `at` predicts for a step."""
        return self.value * (self.violations(at) - model.violation(step)) - model.change(step)

    def step(
        self, model: QuadraticSubproblem, lower: FloatArray, upper: FloatArray, sizes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the model's best step within bounds, and the multipliers; may raise the penalty.

        Parameters
        ----------
        model, lower, upper
            Model around the point, and bounds of the step.
        sizes : (n,)
            A noticeable change of each unknown.
        """
        step, multipliers = penalised_step(model, self.value, lower, upper)
        violation = model.violation(step)
        if violation > NEGLIGIBLE_LINEAR_VIOLATION:
            nearly_zero = np.diag(1e-8 / sizes**2)
            feasibility = replace(model, gradient=np.zeros_like(step), hessian=nearly_zero)
            least = model.violation(penalised_step(feasibility, 1.0, lower, upper)[0])
            possible = max(model.violation(np.zeros_like(step)) - least, 0.0)
            for _ in range(MOST_INCREASES):
                if (
                    violation
                    <= least + (1.0 - LEAST_REDUCTION) * possible + NEGLIGIBLE_LINEAR_VIOLATION
                ):
                    break
                self.value *= 10.0
                step, multipliers = penalised_step(model, self.value, lower, upper)
                violation = model.violation(step)
        by_constraint = np.zeros(len(self._equality))
        np.add.at(by_constraint, model.constraint, multipliers)
        return step, by_constraint


NEAREST_POINT_CURVATURE = 1e-4
"""Curvature of the model if there is no cost; the step then leads to the nearest feasible point."""


@dataclass(frozen=True)
class ModelStep:
    """A step and its predicted reduction of the merit.

    Attributes
    ----------
    vector : (n,)
        Change of the point.
    model
        The model that the step minimises.
    multipliers : (constraints,)
        Multipliers of the constraints in the model.
    predicted_reduction
        Predicted reduction of the merit.
    """

    vector: FloatArray
    model: QuadraticSubproblem
    multipliers: FloatArray
    predicted_reduction: float


class SqpLocalModel:
    """The local model around the current iterate; call `move_to` before all other methods.

    Parameters
    ----------
    space
        The search space.
    hessian
        The approximation of the Hessian; see `Sqp`.
    feasibility_only
        True if there is no cost to minimise.
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
        """Whether steps avoid the sides on which simulations fail."""
        self.penalty = PenaltyParameter(self._equality)

    def move_to(
        self, x: FloatArray, at: Evaluation, derivatives: CostDerivatives, multipliers: FloatArray
    ) -> None:
        """Build the model around a point; `multipliers` are the multipliers of the step to it."""
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
        """Return the step with a second-order correction for curved constraints.

        It uses the same Jacobian, and the constraints' values `after` the trial
        (R. Fletcher, section 14.4, as in sqp.py).
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
        """Return whether a kink of a constraint, rather than a jump, may explain a violation."""
        jump = is_jump(self._linearisation, step.vector, after.constraints)
        return not (self._equality.all() or jump)

    def add_linearisation(
        self, x: FloatArray, at: Evaluation, derivatives: CostDerivatives
    ) -> None:
        """Add the linearisation of the constraints at another point, and activate the history."""
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
        """Return bounds of the step from the trust region and the space; 0 for frozen unknowns."""
        radii = np.where(self.derivatives.frozen, 0.0, radius * self._sizes)
        lower = np.maximum(-radii, self._space.lower - self._linearisation.x)
        upper = np.minimum(radii, self._space.upper - self._linearisation.x)
        walls = self.derivatives.walls
        if not self.along_walls or not len(walls):
            return lower, upper
        return np.where(walls < 0, 0.0, lower), np.where(walls > 0, 0.0, upper)
