"""Steps that follow a curved valley or constraint, from trials that were evaluated anyway.

A trial x + v tells how the residuals and constraints bend along v. Solving for the step again with
the residuals r(x + v) - J v in place of r gives v + b, where b is the second-order correction: half
the geodesic acceleration of M. K. Transtrum, J. P. Sethna, arXiv:1201.5885 (2012), and what lets a
method with a penalty pass curved constraints (R. Fletcher, Practical Methods of Optimization, 2nd
ed. (1987), section 14.4). Along the parabola s v + s^2 b a step can go on further than it was
tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.methods.base import Evaluation
from cluster_est.methods.local_model import LocalModel
from workers.messages import FloatArray

CORRECTED = 2
"""Trials, the boldest, that are corrected because they failed or gained less than a shorter one."""
FURTHER = (2.0, 4.0)
"""How many times as far as the best trial to go on along its parabola."""


@dataclass(frozen=True)
class Trials:
    """Steps from one point that have been tried, from the boldest on, and their merits."""

    points: FloatArray
    steps: FloatArray
    evaluations: list[Evaluation]
    merits: FloatArray
    dampings: FloatArray

    @property
    def best(self) -> int:
        """The boldest of those with the least merit."""
        return int(np.argmin(self.merits))

    @property
    def least(self) -> float:
        return float(self.merits[self.best])


def curved_steps(
    model: LocalModel, trials: Trials, before: float
) -> tuple[FloatArray, FloatArray]:
    """Further steps to try, with the dampings that they stand for.

    Parameters
    ----------
    model
        Around the point from which the trials went.
    trials
        What has been tried.
    before
        Merit of the point.

    Returns
    -------
    steps, dampings
        As many as there were trials, at most; none where the correction is larger than the step.
    """
    count, best = len(trials.steps), trials.best
    lowered = trials.least < before
    failed = [i for i in range(best if lowered else count) if np.isfinite(trials.merits[i])]
    steps: list[FloatArray] = []
    dampings: list[float] = []
    for i in failed[:CORRECTED]:
        bend = _bend(model, trials, i)
        if _ratio(model, bend, trials.steps[i]) <= 1.0:
            steps.append(trials.steps[i] + bend)
            dampings.append(float(trials.dampings[i]))
    if lowered:
        step, bend = trials.steps[best], _bend(model, trials, best)
        for s in FURTHER:
            if s * _ratio(model, bend, step) <= 1.0:
                steps.append(s * step + s * s * bend)
                dampings.append(float(trials.dampings[best]) / s)
    return np.array(steps[:count]), np.array(dampings[:count])


def _bend(model: LocalModel, trials: Trials, i: int) -> FloatArray:
    step = trials.steps[i]
    return model.corrected(step, trials.evaluations[i], float(trials.dampings[i])) - step


def _ratio(model: LocalModel, bend: FloatArray, step: FloatArray) -> float:
    """How long the correction is, compared with the step."""
    length = float(np.linalg.norm(model.scale * step))
    return float(np.linalg.norm(model.scale * bend)) / length if length > 0.0 else np.inf
