"""Steps along a curved valley: second-order corrections from trials that were evaluated anyway.

A trial x + v shows the curvature of the residuals along v. Solving for the step again with the
residuals r(x + v) - J v in place of r gives v + b, where b is the second-order correction: half the
geodesic acceleration of M. K. Transtrum, J. P. Sethna, arXiv:1201.5885 (2012). Along the parabola
s v + s^2 b a step can be longer than the trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.least_squares.local_model import LocalModel
from workers.messages import FloatArray

CORRECTED = 2
"""Trials, the longest, that are corrected because they reduced the cost less than a shorter one."""
EXTENSIONS = (2.0, 4.0)
"""Values of s at which the parabola of the best trial is tried, too."""


@dataclass(frozen=True)
class TrialPoints:
    """Points that were tried from one point, the longest step first.

    Attributes
    ----------
    points, steps : (trials, unknowns)
    dampings : (trials,)
        Of the steps.
    evaluations
        Of the points.
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
        """The longest step of those with the least cost."""
        return int(np.argmin(self.costs))

    @property
    def least(self) -> float:
        return float(self.costs[self.best])


def curved_steps(
    model: LocalModel, trials: TrialPoints, before: float
) -> tuple[FloatArray, FloatArray]:
    """Return further steps to try, and the dampings of the trials that they follow from.

    Parameters
    ----------
    model
        Around the point from which the trials started.
    trials
        Evaluated steps.
    before
        Cost of the point.

    Returns
    -------
    steps, dampings
        At most as many as there were trials; none where the correction is larger than the step.
    """
    count, best, costs = len(trials.steps), trials.best, trials.costs
    improved = trials.least < before
    rejected = [i for i in range(best if improved else count) if np.isfinite(costs[i])]
    steps: list[FloatArray] = []
    dampings: list[float] = []
    for i in rejected[:CORRECTED]:
        b = _correction(model, trials, i)
        if model.norm(b) <= model.norm(trials.steps[i]):
            steps.append(trials.steps[i] + b)
            dampings.append(float(trials.dampings[i]))
    if improved:
        v, b = trials.steps[best], _correction(model, trials, best)
        for s in EXTENSIONS:
            if s * model.norm(b) <= model.norm(v):
                steps.append(s * v + s * s * b)
                dampings.append(float(trials.dampings[best]) / s)
    return np.array(steps[:count]), np.array(dampings[:count])


def _correction(model: LocalModel, trials: TrialPoints, i: int) -> FloatArray:
    step = trials.steps[i]
    corrected = model.corrected(step, trials.evaluations[i], float(trials.dampings[i]))
    return np.asarray(corrected - step)
