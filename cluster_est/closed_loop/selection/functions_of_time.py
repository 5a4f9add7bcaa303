"""Functions of time alone, waves and drifts, must earn more than a mechanism.

Such a function describes a disturbance; it holds for these records and for no others. So it is
accepted only where all experiments agree on it. A wave must besides be no resonance of the model
itself and be seen often enough, and a mechanism that does nearly as much comes first.

A drift or a wave in time follows the slow part of whatever disturbs an experiment: it closes most
of the gap to the noise, and predicts what was left out, without being what is missing. One that is
really there leaves noise. So those that leave more are taken out again at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.selection.refits import RefittedCandidate
from cluster_est.closed_loop.selection.rounds import (
    SelectionResult,
)
from workers.messages import FloatArray


@dataclass(frozen=True)
class WaveThresholds:
    """Thresholds that a wave in time must pass beside all others.

    Attributes
    ----------
    periods
        That the longest record must have of a wave. Signal: of fewer a drift looks the same.
    nearly
        Share of what it explains that a mechanism must explain to come first. Benchmark.
    apart
        Of its strength, by which the experiments may want another function of time on average.
        Theory: with phases or signs at random what all share is smaller than what each wants.
    """

    periods: float = 3.0
    nearly: float = 0.95
    apart: float = 0.5


TIME_FUNCTIONS = WaveThresholds()


FREQUENCY = "f"
"""Coefficient of a wave in time, in rad/s; its parts are a and b."""

WAVE_PARTS = ("a", "b")
"""Coefficients of a wave, that of its sine and that of its cosine."""

MODES = 5
"""Places along a record at which the eigenvalues of the model are looked at."""


def admissible(
    fitter: Fitter, current: FittedModel, contenders: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Contenders whose waves in time may be believed; the one to be chosen first.

    Parameters
    ----------
    current
        The structure that they grow from.
    contenders
        The best first.
    """
    left = [c for c in contenders if _is_admissible(fitter, current, c.fitted)]
    if not left or not _waves(left[0].fitted, current):
        return left
    gain = current.sse - left[0].fitted.sse
    least = TIME_FUNCTIONS.nearly * gain
    others = [c for c in left if not _waves(c.fitted, current) and not c.candidate.form.free]
    first = [c for c in others if current.sse - c.fitted.sse >= least]
    return [*first, *(c for c in left if c not in first)] if first else left


def period_of(candidate: EffectCandidate, fitted: FittedModel) -> float:
    """Return the period in seconds of a wave in time; NaN for what is none."""
    frequency = fitted.estimates.get(f"{candidate.effect.name}.{FREQUENCY}", np.nan)
    wave = candidate.form.of_time_alone and frequency > 0.0
    return 2.0 * np.pi / frequency if wave else np.nan


def residuals_without(fitted: FittedModel, candidate: EffectCandidate) -> FloatArray:
    """Return the residuals that a wave in time leaves when it is taken away, to first order."""
    labels = [u.label for u in fitted.space.unknowns]
    names = [f"{candidate.effect.name}.{part}" for part in WAVE_PARTS]
    columns = [labels.index(name) for name in names if name in labels]
    return fitted.residuals - fitted.jacobian[:, columns] @ fitted.x[columns]


def _waves(fitted: FittedModel, current: FittedModel) -> list[EffectCandidate]:
    """The effects that are new, and waves in time."""
    new = [c for c in fitted.added if c.effect.name not in current.structure]
    return [c for c in new if np.isfinite(period_of(c, fitted))]


def _is_admissible(fitter: Fitter, current: FittedModel, fitted: FittedModel) -> bool:
    new = [c for c in fitted.added if c.effect.name not in current.structure]
    if not all(_agrees(fitter, fitted, c) for c in new if c.form.of_time_alone):
        return False
    for candidate in _waves(fitted, current):
        period = period_of(candidate, fitted)
        records = [record for record in fitter.records.items if len(record.times)]
        longest = max(float(np.ptp(record.times)) for record in records)
        if longest < TIME_FUNCTIONS.periods * period:
            return False
        if _is_resonance(fitter, current, 2.0 * np.pi / period):
            return False
    return True


def _is_resonance(fitter: Fitter, current: FittedModel, frequency: float) -> bool:
    """Return whether a frequency lies within the width of a resonance of the model.

    Whatever disturbs a model with little damping leaves a residual there. A mode with eigenvalue
    s is one where its damping ratio -Re(s) / |s| is below 1/2; its width is |Re(s)|, half of that
    of its power, but never counted below a tenth of its frequency. Where a model is not linear its
    modes change along a record: one that is there for less than half of it does not ring for long.
    """
    for trajectory in fitter.trajectories(current):
        if trajectory.linear is None:
            return False
        steps = np.linspace(0, len(trajectory.linear.times) - 1, MODES).astype(int)
        places = np.unique(steps).tolist()
        near = [_rings_at(trajectory.linear.A.at(step), frequency) for step in places]
        if 2 * sum(near) >= len(places):
            return True
    return False


def _rings_at(matrix: FloatArray, frequency: float) -> bool:
    """Return whether a mode of a linear system has this frequency within its width."""
    modes = np.linalg.eigvals(matrix)
    size = np.abs(modes)
    rings = (modes.imag > 0.0) & (-modes.real < 0.5 * size)
    width = np.maximum(np.abs(modes.real), 0.1 * size)
    return bool(np.any(rings & (np.abs(modes.imag - frequency) <= width)))


def _agrees(fitter: Fitter, fitted: FittedModel, candidate: EffectCandidate) -> bool:
    """Return whether each experiment by itself wants nearly the function of time that all share.

    To first order, the strengths that an experiment wants are those of the fit and the step of
    least squares on its own residual. Of that step, what white noise alone would make is allowed
    for. With one experiment there is nothing to compare.
    """
    labels = [u.label for u in fitted.space.unknowns]
    names = [f"{candidate.effect.name}.{strength}" for strength in candidate.strengths]
    if len(fitter.train) < 2 or not names or not all(name in labels for name in names):
        return True
    columns = [labels.index(name) for name in names]
    shared = np.array([fitted.x[column] for column in columns])
    squares, weights = [], []
    for rows in fitted.space.rows:
        own: FloatArray = fitted.jacobian[rows][:, columns]
        size = float(np.linalg.norm(own))
        if size > 0.0:
            inverse = np.linalg.pinv(own, rcond=1e-6)
            step = -inverse @ fitted.residuals[rows]
            left = fitted.residuals[rows] + own @ step
            noise = float(np.mean(left**2)) * float(np.add.reduce(inverse**2, axis=None))
            squares.append(float(step @ step) - noise)
            weights.append(size)
    if not squares:
        return True
    apart = float(np.sqrt(max(np.average(squares, weights=weights), 0.0)))
    return apart <= TIME_FUNCTIONS.apart * float(np.linalg.norm(shared))


def functions_of_time(found: SelectionResult) -> tuple[EffectCandidate, ...]:
    """Return the effects that were added and are functions of time alone."""
    return tuple(c for c in found.current.added if c.form.of_time_alone)
