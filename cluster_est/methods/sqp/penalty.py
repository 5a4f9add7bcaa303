"""The penalty on violated constraints, in the exact l1 merit function.

    merit = cost + penalty * sum of the violations

A penalty above all multipliers makes a solution of the constrained problem a minimum of the merit.
One far above makes a search creep along curved constraints, and trust linearised constraints where
they are wrong. So it starts low and grows, tenfold at a time, only while a step would not reduce
the linearised violation although the model could: the weakest form of the steering rule of
R. H. Byrd, J. Nocedal, R. A. Waltz, Optim. Methods Softw. 23 (2008) 197-213,
doi:10.1080/10556780701394169.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import TOLERANCE, Evaluation
from cluster_est.methods.evaluation_status import is_defined
from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem, penalised_step
from workers.messages import FloatArray

INITIAL = 0.01
"""The first penalty, in units of the cost or of its largest change by one unknown."""
LEAST_REDUCTION = 0.1
"""Part of the possible reduction of the violation that every step must predict."""
MOST_INCREASES = 12
"""Limit of tenfold increases for one step."""
NEGLIGIBLE = 1e-3 * TOLERANCE


class PenaltyParameter:
    """The current penalty; `equality` says which constraints must be 0."""

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
        """Return the merit; infinite where a simulation failed."""
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
            The model around the point, and the bounds of the step.
        sizes : (n,)
            A noticeable change of each unknown.
        """
        step, multipliers = penalised_step(model, self.value, lower, upper)
        violation = model.violation(step)
        if violation > NEGLIGIBLE:
            nearly_zero = np.diag(1e-8 / sizes**2)
            feasibility = replace(model, gradient=np.zeros_like(step), hessian=nearly_zero)
            least = model.violation(penalised_step(feasibility, 1.0, lower, upper)[0])
            possible = max(model.violation(np.zeros_like(step)) - least, 0.0)
            for _ in range(MOST_INCREASES):
                if violation <= least + (1.0 - LEAST_REDUCTION) * possible + NEGLIGIBLE:
                    break
                self.value *= 10.0
                step, multipliers = penalised_step(model, self.value, lower, upper)
                violation = model.violation(step)
        by_constraint = np.zeros(len(self._equality))
        np.add.at(by_constraint, model.constraint, multipliers)
        return step, by_constraint
