"""Forward selection: one effect after the other, until nothing is missing or nothing helps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.screening.evidence import CandidateEvidence, CandidateStage
from cluster_est.closed_loop.screening.screen import ScreeningResult, findings, refreshed, screen
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction, predict, stays_bounded
from cluster_est.closed_loop.selection.declared_model import fit_declared
from cluster_est.closed_loop.selection.pairs import refit_pairs
from cluster_est.closed_loop.selection.refine import (
    RefittedCandidate,
    alternatives,
    plainest,
    refit,
)
from cluster_est.closed_loop.selection.revise import Rivals, revise
from cluster_est.closed_loop.selection.rounds import (
    RejectionReason,
    SelectionResult,
    SelectionRound,
)
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.statistics.noise import estimate_noise
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.methods.least_squares.method import LeastSquares

AGAIN = LeastSquares(trials=2, max_iterations=15, ftol=1e-6, xtol=1e-7, differences="forward")


@dataclass(frozen=True)
class _RoundStart:
    """The model that a round begins with, its prediction and screening, and the noise's squares."""

    model: FittedModel
    prediction: LeaveOneOutPrediction
    screening: ScreeningResult
    floor: float


@dataclass(frozen=True)
class _RoundEnd:
    """The end of a round; the winner and its prediction are None where nothing was added."""

    seen: SelectionRound
    won: RefittedCandidate | None = None
    prediction: LeaveOneOutPrediction | None = None


def forward_selection(
    workbench: LoopWorkbench, declared: FitStart, *, again: bool = True
) -> SelectionResult:
    """Fit the declared model and add effects to it while they earn it."""
    base = fit_declared(workbench, declared)
    noise = estimate_noise(base.residuals, workbench.records)
    floor = workbench.noise_floor(noise)
    current, prediction = base, predict(workbench, base)
    base_prediction = prediction
    steps: list[SelectionRound] = []
    seen: list[CandidateEvidence] = []
    rivals: Rivals = {}
    passed = {frozenset(c.effect.name for c in base.added)}
    while True:
        number = len(steps) + 1
        screening = screen(workbench, current, number)
        end = _round(workbench, _RoundStart(current, prediction, screening, floor))
        steps.append(end.seen)
        seen += _noted(workbench, current, end, number)
        won = end.won
        if won is None or end.prediction is None:
            break
        if again and not current.added and _was_local(workbench, base, won):
            restart = FitStart(declared.problem, _declared_only(won), declared.added)
            return forward_selection(workbench, restart, again=False)
        grown, better = won.fitted, end.prediction
        left = alternatives(end.seen.contenders, won, workbench.thresholds.refinement)
        for candidate in grown.added[len(current.added) :]:
            rivals[candidate.effect.name] = (won, left)
        if current.added:
            grown = revise(workbench, grown, screening.count, floor, rivals)
            better = predict(workbench, grown) if grown is not won.fitted else better
        names = frozenset(c.effect.name for c in grown.added)
        if names in passed:
            break
        passed.add(names)
        current, prediction = grown, better
    return SelectionResult(
        base, current, base_prediction, prediction, rivals, tuple(steps), tuple(seen), noise
    )


def _reason_to_stop(workbench: LoopWorkbench, begun: _RoundStart) -> RejectionReason | None:
    """Return why nothing need be refitted; None if something may be missing."""
    settings, screening = workbench.settings, begun.screening
    if not screening.trials:
        return RejectionReason.NO_CANDIDATE
    if screening.p > settings.significance:
        return RejectionReason.NOT_SIGNIFICANT
    if screening.p_white > settings.significance:
        return RejectionReason.COLOURED_NOISE
    if len(begun.model.added) >= settings.max_effects:
        return RejectionReason.LIMIT_OF_EFFECTS
    return None


def _round(workbench: LoopWorkbench, begun: _RoundStart) -> _RoundEnd:
    """Try to add something to a model."""
    settings, screening = workbench.settings, begun.screening
    known = len(begun.model.added)
    stop = _reason_to_stop(workbench, begun)
    if stop is not None:
        return _RoundEnd(SelectionRound(screening, (), stop))
    contenders = refit(workbench, begun.model, screening, begun.floor)
    named = [c for c in contenders if not c.candidate.form.free]
    single = _best_of(workbench, begun, named)
    thresholds = workbench.thresholds.selection
    if not settings.pairs or (single.won is not None and single.seen.closed >= thresholds.hard):
        return single
    if known + 2 > settings.max_effects:
        return single
    pair = _best_of(workbench, begun, refit_pairs(workbench, begun.model, screening))
    if single.won is None and pair.won is None:  # a free table fits anything, so it comes last
        tables = [c for c in contenders if c.candidate.form.free]
        return _best_of(workbench, begun, tables)
    if pair.won is None:
        return single
    price = thresholds.pair_price * np.log(screening.count)
    if single.won is not None and pair.won.criterion + price > single.won.criterion:
        return single
    return pair


def _best_of(
    workbench: LoopWorkbench, begun: _RoundStart, contenders: Sequence[RefittedCandidate]
) -> _RoundEnd:
    """The best contender that stays bounded, if it passes the gates."""
    current = begun.model
    left = [c for c in contenders if c.criterion < current.criterion(workbench.records)]
    while left:
        chosen = plainest(left, workbench.thresholds.refinement)
        if stays_bounded(workbench, chosen.fitted, current):
            break
        left = [c for c in left if c is not chosen]
    if not left:
        why = RejectionReason.NO_IMPROVEMENT
        return _RoundEnd(SelectionRound(begun.screening, tuple(contenders), why))
    after = predict(workbench, chosen.fitted)
    gain, closed = _gain(workbench, begun, chosen), _closed(workbench, begun, after)
    failed = _failed_gate(workbench, begun, chosen.fitted, after, gain, closed)
    seen = SelectionRound(begun.screening, tuple(left), failed, gain, closed)
    return _RoundEnd(seen) if failed is not None else _RoundEnd(seen, chosen, after)


def _gain(workbench: LoopWorkbench, begun: _RoundStart, chosen: RefittedCandidate) -> float:
    """Gain of the criterion, less what the choice among the candidates must pay."""
    known = len(begun.model.added)
    added = len(chosen.fitted.added) - known
    price = workbench.thresholds.selection.choice_price
    # each further effect must earn more: what the ones before leave is partly their own error
    penalty = price * added * (1 + known) * np.log(begun.screening.count)
    return float(begun.model.criterion(workbench.records) - chosen.criterion - penalty)


def _closed(workbench: LoopWorkbench, begun: _RoundStart, after: LeaveOneOutPrediction) -> float:
    """Share of the gap between predictions and noise that is closed."""
    before, floor = begun.prediction, begun.floor
    least = workbench.thresholds.selection.least_gap * floor
    return (before.total - after.total) / max(before.total - floor, least)


def _failed_gate(
    workbench: LoopWorkbench,
    begun: _RoundStart,
    grown: FittedModel,
    after: LeaveOneOutPrediction,
    gain: float,
    closed: float,
) -> RejectionReason | None:
    """The first gate that a grown model does not pass; None if it passes all."""
    thresholds, current = workbench.thresholds.selection, begun.model
    if gain <= 0.0:
        return RejectionReason.LITTLE_GAIN
    solo = False
    if after.total >= begun.prediction.total:
        few = _improved(current, grown, thresholds.solo_share) <= thresholds.minority
        solo = gain > thresholds.solo_gain and few
        if not solo:
            return RejectionReason.NOT_PREDICTED
    open_gap = current.sse > thresholds.gap * begun.floor
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
    begun: _RoundStart,
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


def _was_local(workbench: LoopWorkbench, base: FittedModel, won: RefittedCandidate) -> bool:
    """Return whether the declared model does as well from the new parameters."""
    values = _declared_only(won)
    (fit,) = workbench.fit(
        LoopStage.DECLARED_AGAIN, [FitStart(base.problem, values, base.added)], AGAIN
    )
    return fit is not None and fit.sse < workbench.thresholds.selection.local_minimum * base.sse


def _declared_only(won: RefittedCandidate) -> dict[str, float]:
    names = [c.effect.name for c in won.fitted.added]
    estimates = won.fitted.estimates.items()
    return {k: v for k, v in estimates if not any(k.startswith(f"{n}.") for n in names)}


def _noted(
    workbench: LoopWorkbench, current: FittedModel, end: _RoundEnd, number: int
) -> list[CandidateEvidence]:
    """The candidates of a round, with how far each came."""
    found = findings(end.seen.screening, current, number)
    base = current.criterion(workbench.records)
    known = len(current.added)
    reached = [
        (c, CandidateStage.REFITTED)
        for c in end.seen.contenders
        if len(c.fitted.added) == known + 1
    ]
    if end.won is not None:
        reached.append((end.won, CandidateStage.ACCEPTED))
    for contender, stage in reached:
        for candidate in contender.fitted.added[known:]:
            name = candidate.effect.name
            if name in found:
                found[name] = refreshed(found[name], stage, contender.criterion - base)
    return list(found.values())
