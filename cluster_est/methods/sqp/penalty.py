"""The penalty on violated constraints: what makes one number of a cost and its constraints.

    merit = cost + penalty * sum of the violations

A penalty above all multipliers makes a solution of the constrained problem a minimum of the merit.
One far above makes a search creep along bent constraints, and trust linearised constraints where
they are wrong. So it starts low and grows, tenfold at a time, only while a step would make no
headway towards the constraints although the model could: the weakest form of the steering rule of
R. H. Byrd, J. Nocedal, R. A. Waltz, Optim. Methods Softw. 23 (2008) 197-213,
doi:10.1080/10556780701394169.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.base import TOLERANCE, Evaluation
from cluster_est.methods.sqp.evaluation_cache import usable
from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem, penalised_step
from workers.messages import FloatArray

FIRST = 0.01
"""The first penalty, in units of the cost or of what the steepest unknown changes in it."""
HEADWAY = 0.1
"""Part of the possible progress towards the constraints that every step must promise."""
STEEPEST = 12
"""How often the penalty may grow tenfold for one step."""
NEGLIGIBLE = 1e-3 * TOLERANCE


class PenaltyParameter:
    """The current penalty; `equality` says which constraints must be 0."""

    def __init__(self, equality: npt.NDArray[np.bool_]) -> None:
        self._equality = equality
        self.value = 0.0

    def begin(self, cost: float, steepest: float) -> None:
        """Choose the first penalty from the cost and its largest change by one unknown."""
        if self.value == 0.0:
            self.value = FIRST * max(abs(cost), steepest) or 1.0

    def violations(self, at: Evaluation) -> float:
        """Their sum."""
        values = at.constraints
        sizes = np.where(self._equality, np.abs(values), np.maximum(values, 0.0))
        return float(np.add.reduce(sizes))

    def merit(self, at: Evaluation) -> float:
        """Infinite where a simulation failed."""
        return at.cost + self.value * self.violations(at) if usable(at) else np.inf

    def promised(self, model: QuadraticSubproblem, at: Evaluation, step: FloatArray) -> float:
        """The decrease of the merit that a model of the surroundings of `at` expects."""
        return self.value * (self.violations(at) - model.violation(step)) - model.change(step)

    def step(
        self, model: QuadraticSubproblem, lower: FloatArray, upper: FloatArray, sizes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The model's best step within bounds, and the multipliers; may raise the penalty.

        Parameters
        ----------
        model, lower, upper
            What is known of the surroundings, and the room of the step.
        sizes : (n,)
            What a noticeable change of each unknown is.
        """
        step, multipliers = penalised_step(model, self.value, lower, upper)
        left = model.violation(step)
        if left > NEGLIGIBLE:
            short = np.diag(1e-8 / sizes**2)
            bare = replace(model, gradient=np.zeros_like(step), hessian=short)
            least = model.violation(penalised_step(bare, 1.0, lower, upper)[0])
            possible = max(model.violation(np.zeros_like(step)) - least, 0.0)
            for _ in range(STEEPEST):
                if left <= least + (1.0 - HEADWAY) * possible + NEGLIGIBLE:
                    break
                self.value *= 10.0
                step, multipliers = penalised_step(model, self.value, lower, upper)
                left = model.violation(step)
        each = np.zeros(len(self._equality))
        np.add.at(each, model.constraint, multipliers)
        return step, each
