"""Directions of candidates by simulating each: in co-simulation, and with process noise.

There the states are hidden, or a Kalman filter corrects them: what a candidate changes in one
prediction is in part gone in the next, as a filter of the same gains would have it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from cluster_est.closed_loop.screening.directions import CandidatePoint, added_at
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.problem.unknowns import Unknown
from workers.effects.site import EffectSite
from workers.messages import FloatArray


def probe(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
) -> list[FloatArray]:
    """The direction of each trial, (residuals, width), all in one queue.

    A strength is switched on by a little, and the change of the residuals divided by how much; an
    effect that can only be switched on by a finite amount is, by its whole amount.
    """
    asked, amounts = [], []
    amount = workbench.thresholds.screening.probe_amount
    for trial in trials:
        rows, steps = _switched(trial, trajectories, amount)
        start = fitted.start.plus(trial.candidate, trial.values)
        space = workbench.space(start)
        points = np.array([_point(fitted, space.unknowns, trial, row) for row in rows])
        asked.append((space, points))
        amounts.append(steps)
    found = []
    answers = workbench.evaluate(LoopStage.PROBE, asked)
    for trial, steps, seen in zip(trials, amounts, answers, strict=True):
        columns = [
            (at.residuals - fitted.residuals) / step if at.ok else np.zeros(workbench.size)
            for at, step in zip(seen, steps, strict=True)
        ]
        found.append(np.column_stack(columns).reshape(workbench.size, trial.width))
    return found


def _switched(
    trial: CandidatePoint, trajectories: Sequence[LinearisedTrajectory], amount: float
) -> tuple[list[FloatArray], list[float]]:
    """Coefficients for each column, and what its change is to be divided by."""
    candidate = trial.candidate
    values = np.array(trial.values)
    if not candidate.strengths:
        return [values], [1.0]
    rows, steps = [], []
    for i, coefficient in enumerate(candidate.form.coefficients):
        if coefficient.name in candidate.strengths:
            step = amount * _size(trial, trajectories)
            row = values.copy()
            row[i] = step
            rows.append(row)
            steps.append(step)
    return rows, steps


def _size(trial: CandidatePoint, trajectories: Sequence[LinearisedTrajectory]) -> float:
    """The strength that changes its signal by as much as the signal itself."""
    candidate = trial.candidate
    added = np.concatenate(
        [added_at(trajectory, trial, _ones(trajectory)) for trajectory in trajectories]
    )
    swing = float(np.sqrt(np.mean(added**2))) or 1.0
    if candidate.site.kind == "parameter":
        return 1.0 / swing
    signal = _changed(trajectories, candidate.site)
    return float(np.sqrt(np.mean(signal**2)) or 1.0) / swing


def _ones(trajectory: LinearisedTrajectory) -> FloatArray:
    """Values of the parameters, each over its own."""
    return np.ones(0 if trajectory.linear is None else len(trajectory.linear.parameter_names))


def _changed(trajectories: Sequence[LinearisedTrajectory], site: EffectSite) -> FloatArray:
    """The signal that an effect at a site changes, a derivative among them."""
    if not site.at_rates:
        return pooled(trajectories, site.target)
    linear = [trajectory.linear for trajectory in trajectories if trajectory.linear is not None]
    return np.concatenate(
        [each.derivatives[:, each.state_names.index(site.target)] for each in linear]
    )


def _point(
    fitted: FittedModel, unknowns: Sequence[Unknown], trial: CandidatePoint, row: FloatArray
) -> FloatArray:
    """The fit's point with the effect's coefficients behind it."""
    names = [c.name for c in trial.candidate.form.coefficients]
    own = [
        u.to_search(float(row[names.index(u.label.rpartition(".")[2])]))
        for u in unknowns[len(fitted.x) :]
    ]
    return np.concatenate([fitted.x, own])
