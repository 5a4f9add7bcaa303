"""The Gauss-Newton model of a least-squares search with general constraints.

A step minimises

    |J p + r|^2 + p'Sp / 2 + damping |D p|^2 + penalty (sum of the violations of c + A p)

within the bounds: the model of an exact penalty function, which is also what a step must lower. So
there is a step where the linearised constraints contradict each other, and more damping always
makes it shorter. The penalty is steered: it grows until steps satisfy the linearised constraints
or, where they cannot, remove most of what can be removed.

References: R. Fletcher, Practical Methods of Optimization, 2nd ed. (1987), section 14.3; R. H.
Byrd, J. Nocedal, R. A. Waltz, Steering exact penalty methods for nonlinear programming, Optim.
Methods Softw. 23 (2008) 197-213, doi:10.1080/10556780701394169.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import Evaluation
from cluster_est.methods.missing_curvature import MissingCurvature, positive_root
from cluster_est.methods.constraint_planes import Cuts, Plane
from cluster_est.methods.held_step import Held, held_step
from cluster_est.methods.local_model import LocalModel, Weighted, longest_step, sizes
from cluster_est.methods.quadratic_program import Model, penalised_step
from cluster_est.space import Space
from workers.messages import FloatArray

SATISFIED = 1e-9
"""A violation up to this is not worth a step of its own."""
NEARLY_UNDAMPED = 1e-10
REDUCIBLE = 1e-6
"""Part of the violation that a step must be able to remove, or the constraints contradict."""
MOST = 0.9
"""Part of what can be removed of the violation that a step has to remove."""
NEAR = 1e-3
"""A violation up to which the penalty may fall with the squares."""
FAR = 1e4
"""Longest step, over its size, of an unknown of which nothing tells its size."""
WEAK = 0.1
"""Least scale of an unknown: what a change by its size does, over the root of the merit."""


@dataclass(frozen=True)
class Knowledge:
    """What a search with constraints carries from one point to the next.

    Attributes
    ----------
    penalty, squares
        Weight of the violations in the merit, and the sum of squares when it was last lowered.
    curvature
        What the Gauss-Newton matrix lacks.
    cuts
        What is known of the constraints elsewhere.
    """

    penalty: float = 0.0
    squares: float = np.inf
    curvature: MissingCurvature | None = None
    cuts: Cuts = field(default_factory=Cuts)


class ConstrainedModel(LocalModel):
    """A Gauss-Newton model with linearised constraints.

    Attributes
    ----------
    reducible
        Whether a step can lower the violation, to first order.
    """

    alike = 1e-3

    def __init__(
        self,
        space: Space,
        plane: Plane,
        seen: Weighted,
        scale: FloatArray,
        knowledge: Knowledge,
    ) -> None:
        x, self._seen, self._equality = plane.x, seen, space.equality
        self.squares = seen.squares
        self._violation = total_violation(plane.values, self._equality)
        penalty = knowledge.penalty or seen.squares or 1.0
        merit = seen.squares + penalty * self._violation
        size = sizes(space, x)
        self.scale = np.maximum(scale, WEAK * np.sqrt(merit or 1.0) / size)
        room = np.minimum(longest_step(space, x), FAR * size)
        self._lower = np.maximum(space.lower - x, -room) * self.scale
        self._upper = np.minimum(space.upper - x, room) * self.scale

        basis, self._factor = np.linalg.qr(seen.matrix / self.scale)
        self._basis = np.ascontiguousarray(basis.T)
        self._gradient = 2.0 * (seen.matrix.T @ seen.residuals)
        missing = np.zeros((space.size, space.size))
        if knowledge.curvature is not None:
            known = 2.0 * (seen.matrix.T @ seen.matrix)
            missing = knowledge.curvature.updated(x, self._gradient, plane.slopes, known)
        self._bend = positive_root(0.5 * missing / np.outer(self.scale, self.scale))

        which, values, slopes = knowledge.cuts.rows(x, self._equality)
        self._rows = np.concatenate([np.arange(len(plane.values)), which])
        self._row_equality = self._equality[self._rows] & (np.arange(len(self._rows)) < len(plane.values))
        self._values = np.concatenate([plane.values, values])
        self._slopes = np.vstack([plane.slopes, slopes]) / self.scale
        multipliers, squares = self._steer(penalty, knowledge.squares)
        own = np.zeros(len(plane.values))
        np.add.at(own, self._rows, multipliers)
        curvature = MissingCurvature(missing, x, self._gradient, plane.slopes, own)
        self.knowledge = Knowledge(self._penalty, squares, curvature, knowledge.cuts)
        self.optimality = self._stationarity(space, x, multipliers)

    def step(self, damping: float) -> FloatArray:
        residuals = self._basis @ self._seen.residuals
        return self._solve(residuals, self._values, damping, self._penalty)[0] / self.scale

    def corrected(self, step: FloatArray, at: Evaluation, damping: float) -> FloatArray:
        bent = self._basis @ (self._seen.roots * at.residuals - self._seen.matrix @ step)
        count = len(at.constraints)
        values = self._values.copy()
        values[:count] = at.constraints - self._slopes[:count] @ (self.scale * step)
        return self._solve(bent, values, damping, self._penalty)[0] / self.scale

    def gain(self, step: FloatArray) -> float:
        change = self._seen.matrix @ step
        lowered = -float(np.add.reduce(change * (change + 2.0 * self._seen.residuals)))
        bend = self._bend @ (self.scale * step)
        lowered -= float(np.add.reduce(bend * bend))
        return lowered + self._penalty * (self._violation - self._left(self.scale * step))

    def merit(self, at: Evaluation) -> float:
        if not at.ok or np.isnan(at.cost) or np.isnan(at.constraints).any():
            return np.inf
        return at.cost + self._penalty * total_violation(at.constraints, self._equality)

    def surprised(self, step: FloatArray, at: Evaluation) -> float:
        """By how much the violation at a trial exceeds what was expected, in units of the merit."""
        if not at.ok or np.isnan(at.constraints).any():
            return 0.0
        known = total_violation(at.constraints, self._equality)
        return self._penalty * (known - self._left(self.scale * step))

    def edges(self, step: FloatArray, at: Evaluation) -> list[int]:
        """Inequalities that are violated at a trial much more than expected."""
        count = len(at.constraints)
        expected = np.maximum((self._values + self._slopes @ (self.scale * step))[:count], 0.0)
        excess = np.where(self._equality, 0.0, at.constraints - expected)
        return [int(i) for i in np.flatnonzero(excess > 0.1 * excess.max(initial=0.0))]

    def _left(self, step: FloatArray) -> float:
        """Sum of the violations expected after a step, in units of the scale."""
        return self._program(np.zeros(0), np.zeros((0, 0)), self._values).violation(step)

    def _program(self, gradient: FloatArray, hessian: FloatArray, values: FloatArray) -> Model:
        return Model(gradient, hessian, values, self._slopes, self._rows, self._row_equality)

    def _solve(
        self, residuals: FloatArray, values: FloatArray, damping: float, penalty: float
    ) -> tuple[FloatArray, FloatArray]:
        """Step, in units of the scale, and multipliers."""
        size = len(self.scale)
        factor = np.vstack([self._factor, self._bend, np.sqrt(damping) * np.eye(size)])
        target = np.concatenate([residuals, np.zeros(2 * size)])
        model = self._program(2.0 * (factor.T @ target), 2.0 * (factor.T @ factor), values)
        step, multipliers = penalised_step(model, penalty, self._lower, self._upper)
        problem = Held(factor, target, model, penalty, self._lower, self._upper)
        return held_step(problem, step, multipliers)

    def _steer(self, penalty: float, squares: float) -> tuple[FloatArray, float]:
        """Find a penalty with which steps lower the violation as far as they can."""
        residuals = self._basis @ self._seen.residuals
        step, multipliers = self._solve(residuals, self._values, NEARLY_UNDAMPED, penalty)
        least = 0.0
        self.reducible = True
        if self._left(step) > SATISFIED:
            least = self._left(self._nearest())
            can = self._violation - least
            self.reducible = can > REDUCIBLE * self._violation
            for _ in range(15):
                if self._violation - self._left(step) >= MOST * can - SATISFIED:
                    break
                penalty *= 10.0
                step, multipliers = self._solve(residuals, self._values, NEARLY_UNDAMPED, penalty)
        needed = 2.0 * float(np.abs(multipliers).max(initial=0.0))
        if self.squares <= 0.1 * squares and self._violation <= NEAR:
            penalty, squares = max(needed, self.squares, 0.1 * penalty), self.squares
        self._penalty = max(penalty, needed) if least <= SATISFIED else penalty
        return multipliers, squares

    def _nearest(self) -> FloatArray:
        """The shortest step to the least violation, to first order."""
        size = len(self.scale)
        most = float(np.abs(self._slopes).max(initial=0.0)) or 1.0
        model = self._program(np.zeros(size), 1e-8 * most * np.eye(size), self._values)
        return penalised_step(model, 1.0, self._lower, self._upper)[0]

    def _stationarity(self, space: Space, x: FloatArray, multipliers: FloatArray) -> float:
        """The gradient of the Lagrangian over the sum of the lengths of its parts."""
        own, slopes = self._gradient / self.scale, self._slopes.T
        gradient = own + slopes @ multipliers
        norms = 2.0 * np.linalg.norm(self._seen.matrix, axis=0) / self.scale
        norms = norms * np.sqrt(self.squares) + np.abs(slopes) @ np.abs(multipliers)
        blocked = ((x <= space.lower) & (gradient > 0.0)) | ((x >= space.upper) & (gradient < 0.0))
        usable = ~blocked & (norms > 0.0)
        return float(np.max(np.abs(gradient[usable]) / norms[usable], initial=0.0))


def total_violation(values: FloatArray, equality: npt.NDArray[np.bool_]) -> float:
    """Sum of all violations."""
    return float(np.add.reduce(np.where(equality, np.abs(values), np.maximum(values, 0.0))))
