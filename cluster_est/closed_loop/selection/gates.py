"""The gates that a larger structure must pass to take the place of the accepted one.

Functions of time alone, waves and drifts, must earn more than a mechanism: such a function
describes a disturbance; it holds for these records and for no others. So it is accepted only where
all experiments agree on it. A wave must besides be no resonance of the model itself and be seen
often enough, and a mechanism that does nearly as much comes first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.prediction import LeaveOneOutPrediction, is_usable, predict
from cluster_est.closed_loop.selection.refits import RefittedCandidate, plainest
from cluster_est.closed_loop.selection.rounds import (
    RejectionReason,
    RoundEnd,
    RoundStart,
    SelectionRound,
)
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression
from workers.messages import FloatArray


def reason_to_stop(workbench: LoopWorkbench, begun: RoundStart) -> RejectionReason | None:
    """Return why nothing need be refitted; None if something may be missing."""
    settings, screening = workbench.settings, begun.screening
    if not screening.ranking.trials:
        return RejectionReason.NO_CANDIDATE
    if screening.p > settings.significance:
        return RejectionReason.NOT_SIGNIFICANT
    if screening.p_white > settings.significance:
        return RejectionReason.COLOURED_NOISE
    if len(begun.model.added) >= settings.max_effects:
        return RejectionReason.LIMIT_OF_EFFECTS
    if any(candidate.form.free for candidate in begun.model.added):
        return RejectionReason.FREE_CURVE
    return None


def leaves_more_than_noise(workbench: LoopWorkbench, fitted: FittedModel, floor: float) -> bool:
    """Return whether the residual of a fit is clearly larger than the noise."""
    return fitted.sse > workbench.thresholds.selection.gap * floor


def useful_sse(workbench: LoopWorkbench, begun: RoundStart, added: int) -> float:
    """Return the sum of squares that structures of a round must come down to, to be of any use.

    With the last effect that is allowed a structure must close the least share of the gap, and as
    much of it as a claim needs. What may be the noise of sensors for its size has to close nothing,
    and a smaller structure neither: a further effect may show what it is good for.

    Parameters
    ----------
    added
        Number of effects of the structures.
    """
    settings, floor = workbench.settings, begun.floor
    if added < settings.max_effects:
        return np.inf
    gate = begun.model.sse - settings.least_gain * (begun.model.sse - floor)
    claim = _claim_sse(workbench, begun.base, floor)
    return max(min(gate, claim), _near_noise_sse(workbench, floor))


def claimable_sse(workbench: LoopWorkbench, begun: RoundStart, added: int) -> float:
    """Return the sum of squares above which a structure of so many effects comes to nothing.

    Where nothing can be added to it, it must close as much of the gap as a claim needs, or be the
    noise of sensors for its size.
    """
    if added < workbench.settings.max_effects:
        return np.inf
    return _least_claim_sse(workbench, begun)


def can_be_claimed(workbench: LoopWorkbench, begun: RoundStart, fitted: FittedModel) -> bool:
    """Return whether a structure closes as much as a claim needs, or leaves sensors' noise."""
    return fitted.sse <= _least_claim_sse(workbench, begun)


def _least_claim_sse(workbench: LoopWorkbench, begun: RoundStart) -> float:
    claim = _claim_sse(workbench, begun.base, begun.floor)
    return max(claim, _near_noise_sse(workbench, begun.floor))


def _claim_sse(workbench: LoopWorkbench, base: FittedModel, floor: float) -> float:
    return base.sse - workbench.thresholds.verdict.most * (base.sse - floor)


def _near_noise_sse(workbench: LoopWorkbench, floor: float) -> float:
    settings, thresholds = workbench.settings, workbench.thresholds.verdict
    near = settings.near_noise if workbench.sigma_declared else thresholds.coloured
    return float(near**2 * floor)


def best_that_passes(
    workbench: LoopWorkbench, begun: RoundStart, contenders: Sequence[RefittedCandidate]
) -> RoundEnd:
    """The best contender that stays bounded, if it passes the gates."""
    current = begun.model
    if not contenders:
        return RoundEnd(SelectionRound(begun.screening, (), RejectionReason.LITTLE_PROMISED))
    better = [c for c in contenders if c.criterion < current.criterion(workbench.records)]
    left = admissible(workbench, current, better)
    why = RejectionReason.ONLY_WAVES if better and not left else RejectionReason.NO_IMPROVEMENT
    while left:
        chosen = plainest(left, workbench.thresholds.refinement)
        if is_usable(workbench, chosen.fitted, current):
            break
        left = [c for c in left if c is not chosen]
    if not left:
        return RoundEnd(SelectionRound(begun.screening, tuple(contenders), why))
    after = predict(workbench, chosen.fitted)
    gain, closed = _gain(workbench, begun, chosen), _closed(workbench, begun, after)
    coloured = coloured_noise_explains(workbench, begun, chosen)
    failed = failed_gate(workbench, begun, chosen.fitted, after, gain, closed, coloured=coloured)
    seen = SelectionRound(begun.screening, tuple(left), failed, gain, closed, coloured)
    return RoundEnd(seen) if failed is not None else RoundEnd(seen, chosen, after)


def _gain(workbench: LoopWorkbench, begun: RoundStart, chosen: RefittedCandidate) -> float:
    """Gain of the criterion, less what the choice among the candidates must pay."""
    penalty = _choice_penalty(workbench, begun, chosen)
    return float(begun.model.criterion(workbench.records) - chosen.criterion - penalty)


def _choice_penalty(
    workbench: LoopWorkbench, begun: RoundStart, chosen: RefittedCandidate
) -> float:
    known = len(begun.model.added)
    added = len(chosen.fitted.added) - known
    price = workbench.thresholds.selection.choice_price
    # each further effect must earn more: what the ones before leave is partly their own error
    return float(price * added * (1 + known) * np.log(begun.screening.count))


def coloured_noise_explains(
    workbench: LoopWorkbench, begun: RoundStart, chosen: RefittedCandidate
) -> bool:
    """Return whether autocorrelated noise would explain as much as an effect does.

    The criterion takes noise for white, and counts as many independent samples as there are: what a
    process adds to that of the sensors is slow, and some slow function always follows it. So both
    models are compared once more with an autoregression for the noise of each output: the one of
    what the effect leaves.
    """
    thresholds, records = workbench.thresholds, workbench.records
    before, after = begun.model, chosen.fitted
    longest = max((len(item.times) for item in records.items), default=0)
    order = min(thresholds.selection.autoregression, longest // 10)
    gain = _coloured_gain(before.residuals, after.residuals, records, order)
    unknowns = (after.space.size - before.space.size) * np.log(len(after.residuals))
    return bool(gain <= unknowns + _choice_penalty(workbench, begun, chosen))


def _coloured_gain(
    before: FloatArray, after: FloatArray, records: StackedRecords, order: int
) -> float:
    """Fall of the deviance, if noise is the autoregression that the second residual has.

    A residual that is smooth to rounding has none of a high order; then it is one of a lower.
    """
    for lower in range(order, 0, -1):
        try:
            noise = fit_autoregression(after, records, lower)
            return deviance(before, records, noise) - deviance(after, records, noise)
        except (ValueError, np.linalg.LinAlgError):
            continue
    return deviance(before, records) - deviance(after, records)


def _closed(workbench: LoopWorkbench, begun: RoundStart, after: LeaveOneOutPrediction) -> float:
    """Share of the gap between predictions and noise that is closed."""
    before, floor = begun.prediction, begun.floor
    least = workbench.thresholds.selection.least_gap * floor
    return (before.total - after.total) / max(before.total - floor, least)


def failed_gate(
    workbench: LoopWorkbench,
    begun: RoundStart,
    grown: FittedModel,
    after: LeaveOneOutPrediction,
    gain: float,
    closed: float,
    *,
    coloured: bool,
) -> RejectionReason | None:
    """The first gate that a grown model does not pass; None if it passes all."""
    thresholds, current = workbench.thresholds.selection, begun.model
    if gain <= 0.0:
        return RejectionReason.LITTLE_GAIN
    noise_may_remain = grown.sse <= workbench.thresholds.verdict.coloured**2 * begun.floor
    if noise_may_remain and coloured:
        return RejectionReason.COLOURED_GAIN
    if current.sse - grown.sse <= begun.numerical:
        return RejectionReason.NUMERICAL_ERROR
    solo = False
    if after.total >= begun.prediction.total:
        few = _improved(current, grown, thresholds.solo_share) <= thresholds.minority
        solo = gain > thresholds.solo_gain and few
        if not solo:
            return RejectionReason.NOT_PREDICTED
    open_gap = leaves_more_than_noise(workbench, current, begun.floor)
    little = open_gap and not solo and closed < workbench.settings.least_gain
    if little and not _rest_is_coloured(workbench, begun, grown, after):
        return RejectionReason.LITTLE_EXPLAINED
    return None


def _improved(current: FittedModel, grown: FittedModel, share: float) -> float:
    """Share of the experiments that fit clearly better."""
    better = [
        np.sum(grown.residuals[rows] ** 2) < share * np.sum(current.residuals[rows] ** 2)
        for rows in current.space.rows
    ]
    return float(np.mean(better))


def _rest_is_coloured(
    workbench: LoopWorkbench,
    begun: RoundStart,
    grown: FittedModel,
    after: LeaveOneOutPrediction,
) -> bool:
    """Return whether an effect leaves only coloured noise, so that it did all it could."""
    thresholds, current = workbench.thresholds.selection, begun.model
    better = np.mean(after.squares < begun.prediction.squares)
    fall = current.sse - grown.sse
    if better < thresholds.mostly_better or fall < thresholds.least_fall * current.sse:
        return False
    return screen(workbench, grown, 90).p_white > workbench.settings.significance


FREQUENCY = "f"
"""Coefficient of a wave in time, in rad/s; its parts are a and b."""

PARTS = ("a", "b")
"""Coefficients of a wave, that of its sine and that of its cosine."""

MODES = 5
"""Places along a record at which the eigenvalues of the model are looked at."""


def admissible(
    workbench: LoopWorkbench, current: FittedModel, contenders: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Contenders whose waves in time may be believed; the one to be chosen first.

    Parameters
    ----------
    current
        The structure that they grow from.
    contenders
        The best first.
    """
    left = [c for c in contenders if _is_admissible(workbench, current, c.fitted)]
    if not left or not _waves(left[0].fitted, current):
        return left
    gain = current.sse - left[0].fitted.sse
    least = workbench.thresholds.waves.nearly * gain
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
    names = [f"{candidate.effect.name}.{part}" for part in PARTS]
    columns = [labels.index(name) for name in names if name in labels]
    return fitted.residuals - fitted.jacobian[:, columns] @ fitted.x[columns]


def _waves(fitted: FittedModel, current: FittedModel) -> list[EffectCandidate]:
    """The effects that are new, and waves in time."""
    new = [c for c in fitted.added if c.effect.name not in current.structure]
    return [c for c in new if np.isfinite(period_of(c, fitted))]


def _is_admissible(workbench: LoopWorkbench, current: FittedModel, fitted: FittedModel) -> bool:
    new = [c for c in fitted.added if c.effect.name not in current.structure]
    if not all(_agrees(workbench, fitted, c) for c in new if c.form.of_time_alone):
        return False
    for candidate in _waves(fitted, current):
        period = period_of(candidate, fitted)
        records = [record for record in workbench.records.items if len(record.times)]
        longest = max(float(np.ptp(record.times)) for record in records)
        if longest < workbench.thresholds.waves.periods * period:
            return False
        if _is_resonance(workbench, current, 2.0 * np.pi / period):
            return False
    return True


def _is_resonance(workbench: LoopWorkbench, current: FittedModel, frequency: float) -> bool:
    """Return whether a frequency lies within the width of a resonance of the model.

    Whatever disturbs a model with little damping leaves a residual there. A mode with eigenvalue
    s is one where its damping ratio -Re(s) / |s| is below 1/2; its width is |Re(s)|, half of that
    of its power, but never counted below a tenth of its frequency. Where a model is not linear its
    modes change along a record: one that is there for less than half of it does not ring for long.
    """
    for trajectory in workbench.trajectories(current):
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


def _agrees(workbench: LoopWorkbench, fitted: FittedModel, candidate: EffectCandidate) -> bool:
    """Return whether each experiment by itself wants nearly the function of time that all share.

    To first order, the strengths that an experiment wants are those of the fit and the step of
    least squares on its own residual. Of that step, what white noise alone would make is allowed
    for. With one experiment there is nothing to compare.
    """
    labels = [u.label for u in fitted.space.unknowns]
    names = [f"{candidate.effect.name}.{strength}" for strength in candidate.strengths]
    if len(workbench.train) < 2 or not names or not all(name in labels for name in names):
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
    return apart <= workbench.thresholds.waves.apart * float(np.linalg.norm(shared))
