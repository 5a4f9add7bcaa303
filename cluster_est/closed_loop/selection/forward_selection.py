"""Look for one effect after the other, until nothing is missing or nothing helps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.screening.evidence import CandidateEvidence
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
from cluster_est.closed_loop.statistics.noise import estimate_noise
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.methods.least_squares.method import LeastSquares

SOLO_GAIN = 30.0
"""Gain of the criterion with which an effect may live in a minority of the experiments."""
SOLO_SHARE = 0.98
HARD = 0.7
"""Share of the gap to the noise that a single effect must close, or two at once are tried."""
BIG = 1.15
"""Residual over noise, in squares, above which an effect must close a part of the gap."""
LOCAL_MINIMUM = 0.97
"""The declared model, restarted from the new parameters, must not get below this share."""
AGAIN = LeastSquares(trials=2, max_iterations=15, ftol=1e-6, xtol=1e-7, differences="forward")


@dataclass(frozen=True)
class SelectionRound:
    """One round: what was seen at a model, and what came of it.

    `why` says why nothing was added; empty where something was.
    """

    screening: ScreeningResult = field(repr=False)
    contenders: tuple[RefittedCandidate, ...] = field(repr=False)
    why: str
    gain: float = np.nan
    closed: float = np.nan


@dataclass(frozen=True)
class SelectionResult:
    """Where the search ended.

    Attributes
    ----------
    base, current
        The declared model, and the one with all effects that were added.
    base_prediction, prediction
        Leave-one-out predictions of both.
    rivals
        For each added effect, by name, the contenders that it won against.
    steps, findings
        What was seen on the way.
    noise
        Of each output, in units of its residual.
    """

    base: FittedModel = field(repr=False)
    current: FittedModel = field(repr=False)
    base_prediction: LeaveOneOutPrediction = field(repr=False)
    prediction: LeaveOneOutPrediction = field(repr=False)
    rivals: Rivals = field(repr=False)
    steps: tuple[SelectionRound, ...] = field(repr=False)
    findings: tuple[CandidateEvidence, ...] = field(repr=False)
    noise: np.ndarray

    @property
    def last(self) -> SelectionRound:
        return self.steps[-1]


def search(bench: LoopWorkbench, declared: FitStart, *, again: bool = True) -> SelectionResult:
    """Fit the declared model and add effects to it while they earn it."""
    base = fit_declared(bench, declared)
    noise = estimate_noise(base.residuals, bench.records)
    current, prediction = base, predict(bench, base)
    base_prediction = prediction
    steps: list[SelectionRound] = []
    seen: list[CandidateEvidence] = []
    rivals: Rivals = {}
    passed = {frozenset(c.effect.name for c in base.added)}
    while True:
        number = len(steps) + 1
        screening = screen(bench, current, number)
        full = len(current.added) >= bench.settings.max_effects
        step, won, better = _round(bench, current, prediction, screening, noise, full)
        steps.append(step)
        seen += _noted(bench, current, step, won, number)
        if won is None or better is None:
            break
        if again and not current.added and _was_local(bench, base, won):
            restart = FitStart(declared.problem, _declared_only(won, declared), declared.added)
            return search(bench, restart, again=False)
        grown = won.fitted
        for candidate in grown.added[len(current.added) :]:
            rivals[candidate.effect.name] = (won, alternatives(step.contenders, won))
        if current.added:
            grown = revise(bench, grown, screening.count, bench.noise_floor(noise), rivals)
            better = predict(bench, grown) if grown is not won.fitted else better
        names = frozenset(c.effect.name for c in grown.added)
        if names in passed:
            break
        passed.add(names)
        current, prediction = grown, better
    return SelectionResult(
        base, current, base_prediction, prediction, rivals, tuple(steps), tuple(seen), noise
    )


def _round(
    bench: LoopWorkbench,
    current: FittedModel,
    before: LeaveOneOutPrediction,
    screening: ScreeningResult,
    noise: np.ndarray,
    full: bool,
) -> tuple[SelectionRound, RefittedCandidate | None, LeaveOneOutPrediction | None]:
    """Try to add something to a model."""
    significance = bench.settings.significance
    if screening.p > significance:
        return SelectionRound(screening, (), "nothing significant"), None, None
    if screening.p_white > significance:
        return SelectionRound(screening, (), "coloured noise"), None, None
    if full:
        return SelectionRound(screening, (), "limit of effects"), None, None
    contenders = refit(bench, current, screening, bench.noise_floor(noise))
    named = [c for c in contenders if c.candidate.form.family != "table"]
    step, won, better = _best_of(bench, current, before, screening, named, noise)
    if not bench.settings.pairs or (won is not None and step.closed >= HARD):
        return step, won, better
    if len(current.added) + 2 > bench.settings.max_effects:
        return step, won, better
    pairs = refit_pairs(bench, current, screening)
    paired = _best_of(bench, current, before, screening, pairs, noise)
    two = paired[1]
    if won is None and two is None:  # a free table fits anything, so it comes last
        tables = [c for c in contenders if c.candidate.form.family == "table"]
        return _best_of(bench, current, before, screening, tables, noise)
    if two is None:
        return step, won, better
    if won is not None and two.criterion + 4.0 * np.log(screening.count) > won.criterion:
        return step, won, better
    return paired


def _best_of(
    bench: LoopWorkbench,
    current: FittedModel,
    before: LeaveOneOutPrediction,
    screening: ScreeningResult,
    contenders: Sequence[RefittedCandidate],
    noise: np.ndarray,
) -> tuple[SelectionRound, RefittedCandidate | None, LeaveOneOutPrediction | None]:
    """The best contender that stays bounded, if it passes the gates."""
    left = [c for c in contenders if c.criterion < current.criterion(bench.records)]
    while left:
        chosen = plainest(left)
        if stays_bounded(bench, chosen.fitted, current):
            break
        left = [c for c in left if c is not chosen]
    if not left:
        why = "no candidate improves the fit and stays bounded"
        return SelectionRound(screening, tuple(contenders), why), None, None
    contenders = tuple(left)
    after = predict(bench, chosen.fitted)
    gain, closed, why = _gates(bench, current, chosen, before, after, screening, noise)
    step = SelectionRound(screening, contenders, why, gain, closed)
    return (step, None, None) if why else (step, chosen, after)


def _gates(
    bench: LoopWorkbench,
    current: FittedModel,
    chosen: RefittedCandidate,
    before: LeaveOneOutPrediction,
    after: LeaveOneOutPrediction,
    screening: ScreeningResult,
    noise: np.ndarray,
) -> tuple[float, float, str]:
    """Gain of the criterion, share of the gap to the noise that is closed, and why not if so."""
    added = len(chosen.fitted.added) - len(current.added)
    # each further effect must earn more: what the ones before leave is partly their own error
    penalty = 2.0 * added * (1 + len(current.added)) * np.log(screening.count)
    gain = current.criterion(bench.records) - chosen.criterion - penalty
    floor = bench.noise_floor(noise)
    closed = (before.total - after.total) / max(before.total - floor, 0.02 * floor)
    if gain <= 0.0:
        return gain, closed, "the gain does not pay for the choice among so many candidates"
    solo = False
    if after.total >= before.total:
        solo = gain > SOLO_GAIN and _improved(current, chosen.fitted) <= 0.5
        if not solo:
            return gain, closed, "left-out experiments are not predicted better"
    little = current.sse > BIG * floor and not solo and closed < bench.settings.least_gain
    if little and not _rest_is_coloured(bench, current, chosen.fitted, before, after):
        return gain, closed, "it explains too little of what is missing"
    return gain, closed, ""


def _improved(current: FittedModel, grown: FittedModel) -> float:
    """Share of the experiments that fit clearly better."""
    better = [
        np.sum(grown.residuals[rows] ** 2) < SOLO_SHARE * np.sum(current.residuals[rows] ** 2)
        for rows in current.space.rows
    ]
    return float(np.mean(better))


def _rest_is_coloured(
    bench: LoopWorkbench,
    current: FittedModel,
    grown: FittedModel,
    before: LeaveOneOutPrediction,
    after: LeaveOneOutPrediction,
) -> bool:
    """Whether what an effect leaves unexplained is coloured noise, so that it did all it could."""
    if (
        np.mean(after.squares < before.squares) < 0.75
        or current.sse - grown.sse < 0.02 * current.sse
    ):
        return False
    return screen(bench, grown, 90).p_white > bench.settings.significance


def _was_local(bench: LoopWorkbench, base: FittedModel, won: RefittedCandidate) -> bool:
    """Whether the declared model does as well from the new parameters: no effect was missing."""
    values = _declared_only(won, base.start)
    (fit,) = bench.fit("return", [FitStart(base.problem, values, base.added)], AGAIN)
    return fit is not None and fit.sse < LOCAL_MINIMUM * base.sse


def _declared_only(won: RefittedCandidate, declared: FitStart) -> dict[str, float]:
    names = [c.effect.name for c in won.fitted.added]
    estimates = won.fitted.estimates.items()
    return {k: v for k, v in estimates if not any(k.startswith(f"{n}.") for n in names)}


def _noted(
    bench: LoopWorkbench,
    current: FittedModel,
    step: SelectionRound,
    won: RefittedCandidate | None,
    number: int,
) -> list[CandidateEvidence]:
    """The candidates of a step, with how far each came."""
    found = findings(step.screening, current, number)
    base = current.criterion(bench.records)
    for contender in step.contenders:
        for candidate in contender.fitted.added[len(current.added) :]:
            name = candidate.effect.name
            if name in found and len(contender.fitted.added) == len(current.added) + 1:
                found[name] = refreshed(found[name], "refitted", contender.criterion - base)
    if won is not None:
        for candidate in won.fitted.added[len(current.added) :]:
            name = candidate.effect.name
            if name in found:
                found[name] = refreshed(found[name], "accepted", won.criterion - base)
    return list(found.values())
