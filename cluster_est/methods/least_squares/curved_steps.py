"""Steps that follow a curved valley, from trials that were evaluated anyway.

A trial x + v tells how the residuals bend along v. Solving for the step again with the residuals
r(x + v) - J v in place of r gives v + b, where b is the second-order correction: half the geodesic
acceleration of M. K. Transtrum, J. P. Sethna, arXiv:1201.5885 (2012). Along the parabola
s v + s^2 b a step can go on further than it was tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.least_squares.local_model import LocalModel
from workers.messages import FloatArray

CORRECTED = 2
"""Trials, the boldest, that are corrected because they failed or gained less than a shorter one."""
FURTHER = (2.0, 4.0)
"""How many times as far as the best trial to go on along its parabola."""


@dataclass(frozen=True)
class TriedPoints:
    """Points that were tried from one point, from the boldest on.

    Attributes
    ----------
    points, steps : (trials, unknowns)
    dampings : (trials,)
        Those that the steps stand for.
    evaluations
        What came of them.
    """

    points: FloatArray
    steps: FloatArray
    dampings: FloatArray
    evaluations: list[Evaluation]

    @property
    def costs(self) -> FloatArray:
        """(trials,): infinite where a simulation failed."""
        return np.array([at.cost if at.ok else np.inf for at in self.evaluations])

    @property
    def best(self) -> int:
        """The boldest of those with the least cost."""
        return int(np.argmin(self.costs))

    @property
    def least(self) -> float:
        return float(self.costs[self.best])


def curved_steps(
    model: LocalModel, trials: TriedPoints, before: float
) -> tuple[FloatArray, FloatArray]:
    """Further steps to try, with the dampings that they stand for.

    Parameters
    ----------
    model
        Around the point from which the trials went.
    trials
        What has been tried.
    before
        Cost of the point.

    Returns
    -------
    steps, dampings
        At most as many as there were trials; none where the correction is larger than the step.
    """
    count, best, costs = len(trials.steps), trials.best, trials.costs
    lowered = trials.least < before
    failed = [i for i in range(best if lowered else count) if np.isfinite(costs[i])]
    steps: list[FloatArray] = []
    dampings: list[float] = []
    for i in failed[:CORRECTED]:
        bend = _bend(model, trials, i)
        if model.length(bend) <= model.length(trials.steps[i]):
            steps.append(trials.steps[i] + bend)
            dampings.append(float(trials.dampings[i]))
    if lowered:
        step, bend = trials.steps[best], _bend(model, trials, best)
        for s in FURTHER:
            if s * model.length(bend) <= model.length(step):
                steps.append(s * step + s * s * bend)
                dampings.append(float(trials.dampings[best]) / s)
    return np.array(steps[:count]), np.array(dampings[:count])


def _bend(model: LocalModel, trials: TriedPoints, i: int) -> FloatArray:
    step = trials.steps[i]
    corrected = model.corrected(step, trials.evaluations[i], float(trials.dampings[i]))
    return np.asarray(corrected - step)
