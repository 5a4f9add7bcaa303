"""Directions of candidates in co-simulation, where nobody sees the states: by simulating each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from cluster_est.closed_loop.screening.directions import CandidatePoint, added_at
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.problem.unknown import Unknown
from workers.messages import FloatArray

AMOUNT = 0.01
"""How far a candidate is switched on, as a share of the signal that it changes."""


def probe(
    bench: LoopWorkbench,
    fitted: FittedModel,
    courses: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
) -> list[FloatArray]:
    """The direction of each trial, (residuals, width), all in one queue.

    A strength is switched on by a little, and the change of the residuals divided by how much; an
    effect that can only be switched on by a finite amount is, by its whole amount.
    """
    asked, amounts = [], []
    for trial in trials:
        rows, steps = _switched(trial, courses)
        start = fitted.start.plus(trial.candidate, trial.values)
        space = bench.space(start)
        points = np.array([_point(fitted, space.unknowns, trial, row) for row in rows])
        asked.append((space, points))
        amounts.append(steps)
    found = []
    for trial, steps, seen in zip(trials, amounts, bench.look("probe", asked), strict=True):
        columns = [
            (at.residuals - fitted.residuals) / step if at.ok else np.zeros(bench.size)
            for at, step in zip(seen, steps, strict=True)
        ]
        found.append(np.column_stack(columns).reshape(bench.size, trial.width))
    return found


def _switched(
    trial: CandidatePoint, courses: Sequence[LinearisedTrajectory]
) -> tuple[list[FloatArray], list[float]]:
    """Coefficients for each column, and what its change is to be divided by."""
    candidate = trial.candidate
    values = np.array(trial.values)
    if not candidate.strengths:
        return [values], [1.0]
    rows, steps = [], []
    for i, coefficient in enumerate(candidate.form.coefficients):
        if coefficient.name in candidate.strengths:
            step = AMOUNT * _size(trial, courses)
            row = values.copy()
            row[i] = step
            rows.append(row)
            steps.append(step)
    return rows, steps


def _size(trial: CandidatePoint, courses: Sequence[LinearisedTrajectory]) -> float:
    """How large a strength is that changes its signal by as much as the signal itself."""
    candidate = trial.candidate
    added = np.concatenate([added_at(course, trial, np.zeros(0)) for course in courses])
    swing = float(np.sqrt(np.mean(added**2))) or 1.0
    if candidate.site.kind == "parameter":
        return 1.0 / swing
    signal = pooled(courses, candidate.site.target)
    return float(np.sqrt(np.mean(signal**2)) or 1.0) / swing


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
