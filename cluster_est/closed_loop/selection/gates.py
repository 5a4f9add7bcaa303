"""The gates that a structure must pass to take the place of the accepted one.

Each gate has a name, a threshold, and the origin of this threshold. A setting can leave out a gate
by its name. The origin "theory" names a result of theory. "signal" is a property of measured data
or of a simulation. "setting" is a key of `[closed_loop]`. "benchmark" means that no theory gives
the value: the rates in `scripts/closed_loop_benchmark/RESULTS.md` were measured with it. Tune such
a value only on the benchmark systems with `split="tune"`, never on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.numerical_error import NUMERICAL_ERROR
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.acceptance import (
    TIME_FUNCTIONS,
    LeaveOneOutPrediction,
    admissible,
    can_be_linearised,
    is_usable,
    predict,
)
from cluster_est.closed_loop.selection.refits import (
    RefittedCandidate,
    full_refit,
    most_parsimonious,
)
from cluster_est.closed_loop.selection.rounds import (
    VERDICT,
    RejectionReason,
    RoundEnd,
    RoundStart,
    SelectionRound,
    leaves_more_than_noise,
    out_of_reach,
)
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression
from workers.messages import FloatArray


@dataclass(frozen=True)
class SelectionThresholds:
    """Thresholds that the best contender of a round must pass.

    Attributes
    ----------
    choice_price
        The gain must exceed the logarithm of the number of candidates, times this number. Theory: a
        Bonferroni correction; on the scale of the criterion, the logarithm counts twice.
    pair_price
        The same number for two effects instead of one. Theory: the number of pairs grows as the
        square of the number of candidates.
    solo_gain
        Gain of the criterion above which an effect may act in a minority of the experiments.
        Benchmark.
    minority
        Largest share of the experiments that is a minority. By definition.
    autoregression
        Order of the autoregression with which a gain is compared. Signal: sensor noise with process
        noise added is not an autoregression of low order. The intervals of a fit use lags up to the
        same order.
    """

    choice_price: float = 2.0
    pair_price: float = 4.0
    solo_gain: float = 30.0
    minority: float = 0.5
    autoregression: int = 20


SELECTION = SelectionThresholds()

TRIED = 4
"""Largest number of proposals that are tested in a round, if the first ones predict badly."""


@dataclass(frozen=True)
class Attempt:
    """The best proposal of a round, and its prediction.

    Attributes
    ----------
    begun
        The structure with which the proposal is compared: the accepted one with which the round
        began, or the one that the proposal extends; see `extended_start`.
    chosen, after
        The proposal, and its leave-one-out prediction.
    gain
        Gain of the criterion, minus the penalty for the choice among the candidates.
    closed
        Share of the gap between the error of predictions and the noise that the proposal closes.
    coloured
        Whether autocorrelated noise would explain as much.
    """

    begun: RoundStart = field(repr=False)
    chosen: RefittedCandidate = field(repr=False)
    after: LeaveOneOutPrediction
    gain: float
    closed: float
    coloured: bool

    @property
    def of_few(self) -> bool:
        """Whether the fit improves only in a minority of the experiments, but there by much."""
        current, grown = self.begun.model, self.chosen.fitted
        few = _improved(current, grown) <= SELECTION.minority
        return self.gain > SELECTION.solo_gain and few

    @property
    def predicts_better(self) -> bool:
        return self.after.closes(self.begun.prediction) > 0.0


@dataclass(frozen=True)
class Stop:
    """A condition that ends a search before a proposal; if `part` is None, it is always asked."""

    part: LoopPart | None
    refuses: Callable[[RoundStart], bool]
    reason: RejectionReason
    origin: str


@dataclass(frozen=True)
class Filter:
    """A condition that refuses proposals of a round before the best one is chosen; see `Gate`.

    Attributes
    ----------
    kept
        A function that returns the proposals that pass; the first of them is to be chosen.
    """

    part: LoopPart
    kept: Callable[[Fitter, RoundStart, list[RefittedCandidate]], list[RefittedCandidate]]
    reason: RejectionReason
    threshold: float
    origin: str


@dataclass(frozen=True)
class Gate:
    """A condition that refuses the best proposal of a round.

    Attributes
    ----------
    part
        Name of the gate.
    refuses
        A function that returns whether the gate refuses a proposal. It may simulate.
    reason
        The reason that the summary then gives.
    threshold, origin
        Threshold of the gate, and its origin.
    """

    part: LoopPart
    refuses: Callable[[Attempt, Fitter], bool]
    reason: RejectionReason
    threshold: float
    origin: str


STOPS = (
    Stop(
        None,
        lambda begun: not begun.screening.ranking.trials,
        RejectionReason.NO_CANDIDATE,
        "by definition",
    ),
    Stop(
        LoopPart.SIGNIFICANCE,
        lambda begun: begun.screening.p > begun.settings.significance,
        RejectionReason.NOT_SIGNIFICANT,
        "setting: significance",
    ),
    Stop(
        LoopPart.COLOURED_NOISE,
        lambda begun: _is_coloured_noise(begun),
        RejectionReason.COLOURED_NOISE,
        "setting: significance",
    ),
    Stop(
        None,
        lambda begun: len(begun.model.added) >= begun.settings.max_effects,
        RejectionReason.LIMIT_OF_EFFECTS,
        "setting: max_effects",
    ),
    Stop(
        LoopPart.OUT_OF_REACH,
        lambda begun: out_of_reach(begun),
        RejectionReason.OUT_OF_REACH,
        "theory: greedy selection, if effects explain no more together than alone",
    ),
    Stop(
        LoopPart.CURVE_ENDS,
        lambda begun: _curve_does_most(begun),
        RejectionReason.FREE_CURVE,
        "by definition: the remaining error of such a curve is partly its own",
    ),
)
"""The stop conditions, in the order in which they are asked."""

FILTERS = (
    Filter(
        LoopPart.CRITERION,
        lambda fitter, begun, contenders: _improving(fitter.records, begun, contenders),
        RejectionReason.NO_IMPROVEMENT,
        0.0,
        "by definition",
    ),
    Filter(
        LoopPart.WAVES,
        lambda fitter, begun, contenders: admissible(fitter, begun.model, contenders),
        RejectionReason.ONLY_WAVES,
        TIME_FUNCTIONS.periods,
        "signal: with fewer periods, a drift looks the same",
    ),
)
"""The filters, in the order in which they are asked. The chosen proposal must also stay bounded
(`BOUNDED`); only the best one is asked, because this takes a simulation."""

GATES = (
    Gate(
        LoopPart.CHOICE_PRICE,
        lambda attempt, _: attempt.gain <= 0.0,
        RejectionReason.LITTLE_GAIN,
        SELECTION.choice_price,
        "theory: a Bonferroni correction for the choice among the candidates",
    ),
    Gate(
        LoopPart.COLOURED_GAIN,
        lambda attempt, _: attempt.coloured and _may_leave_noise(attempt),
        RejectionReason.COLOURED_GAIN,
        SELECTION.autoregression,
        "signal: sensor noise with process noise added",
    ),
    Gate(
        LoopPart.NUMERICAL,
        lambda attempt, _: _fall(attempt) <= attempt.begun.numerical,
        RejectionReason.NUMERICAL_ERROR,
        NUMERICAL_ERROR.known,
        "theory: the error of a step, which is known up to this factor",
    ),
    Gate(
        LoopPart.PREDICTION,
        lambda attempt, _: not attempt.predicts_better and not attempt.of_few,
        RejectionReason.NOT_PREDICTED,
        SELECTION.solo_gain,
        "benchmark: the gain above which an effect may act in a minority of the experiments",
    ),
    Gate(
        LoopPart.LEAST_GAIN,
        lambda attempt, fitter: _explains_little(attempt, fitter),
        RejectionReason.LITTLE_EXPLAINED,
        VERDICT.gap,
        "setting: least_gain; benchmark: the gap above which it is required",
    ),
)
"""The gates, in the order in which they are asked."""

OF_ONE_STRUCTURE = (LoopPart.PREDICTION, LoopPart.LEAST_GAIN)
"""Gates whose refusal of one structure says nothing about structures that fit worse."""


def reason_to_stop(begun: RoundStart) -> RejectionReason | None:
    """Return the reason why no refit is needed; None if an effect may be missing."""
    asked = (stop for stop in STOPS if stop.part not in begun.settings.without)
    return next((stop.reason for stop in asked if stop.refuses(begun)), None)


def first_refusal(fitter: Fitter, attempt: Attempt) -> Gate | None:
    """Return the first gate that a proposal does not pass; None if it passes all."""
    asked = (gate for gate in GATES if gate.part not in attempt.begun.settings.without)
    return next((gate for gate in asked if gate.refuses(attempt, fitter)), None)


def choose(fitter: Fitter, begun: RoundStart, proposals: Sequence[RefittedCandidate]) -> RoundEnd:
    """Return the best proposal that stays bounded and passes the gates.

    A proposal that lacks an accepted effect must pass the gates twice: compared with the accepted
    structure, which it replaces, and with the structure that it extends.

    The best fit may predict badly, for example with a flexible law. So if it is refused by a gate
    in `OF_ONE_STRUCTURE`, a few of the next best proposals are tested.

    Parameters
    ----------
    begun
        The start of the round.
    proposals
        Refitted structures other than the accepted one. A structure without additional effects
        pays no penalty for the choice among the candidates.
    """
    current = begun.model
    if not proposals:
        return RoundEnd(SelectionRound(begun.screening, (), RejectionReason.LITTLE_PROMISED))
    left = ranked = sorted(proposals, key=lambda c: c.criterion)
    stopped: dict[frozenset[str], LoopPart] = {}
    why = RejectionReason.NO_IMPROVEMENT
    for filter_ in (each for each in FILTERS if begun.has(each.part) and left):
        kept = filter_.kept(fitter, begun, left)
        known = {id(contender) for contender in kept}
        stopped |= {c.fitted.structure: filter_.part for c in left if id(c) not in known}
        left, why = kept, why if kept else filter_.reason
    refused: SelectionRound | None = None
    tries = TRIED if begun.has(LoopPart.NEXT_BEST) else 1
    while left and tries:
        chosen = most_parsimonious(left)
        rest = [c for c in left if c is not chosen]
        if not may_go_on(fitter, begun, chosen.fitted, current):
            stopped[chosen.fitted.structure] = LoopPart.BOUNDED
            left = rest
            continue
        attempt, failed = _through_gates(fitter, begun, chosen)
        gains = attempt.gain, attempt.closed, attempt.coloured
        why_not = failed.reason if failed else None
        seen = SelectionRound(begun.screening, tuple(left), why_not, *gains)
        if failed is None:
            return RoundEnd(seen, chosen, attempt.after, stopped=stopped)
        stopped[chosen.fitted.structure] = failed.part
        refused, left = refused or seen, rest
        tries = tries - 1 if failed.part in OF_ONE_STRUCTURE else 0
    if refused is not None and refused.coloured:
        refused = replace(refused, coloured=not beyond_coloured_noise(fitter, begun, ranked))
    return RoundEnd(refused or SelectionRound(begun.screening, tuple(ranked), why), stopped=stopped)


def _through_gates(
    fitter: Fitter, begun: RoundStart, chosen: RefittedCandidate
) -> tuple[Attempt, Gate | None]:
    """Return the last comparison of a proposal, and the gate that it does not pass, if any."""
    after = predict(fitter, chosen.fitted)
    attempt = _attempted(fitter, begun, chosen, after)
    failed = first_refusal(fitter, attempt)
    if failed is None and not begun.model.structure <= chosen.fitted.structure:
        attempt = _attempted(fitter, extended_start(fitter, begun, chosen), chosen, after)
        failed = first_refusal(fitter, attempt)
    return attempt, failed


def _attempted(
    fitter: Fitter, begun: RoundStart, chosen: RefittedCandidate, after: LeaveOneOutPrediction
) -> Attempt:
    gain, closed = _gain(fitter.records, begun, chosen), _closed(begun, after)
    coloured = coloured_noise_explains(fitter.records, begun, chosen)
    return Attempt(begun, chosen, after, gain, closed, coloured)


def extended_start(fitter: Fitter, begun: RoundStart, chosen: RefittedCandidate) -> RoundStart:
    """Return the start of a round at the structure that a proposal extends.

    A proposal that lacks an accepted effect extends only the declared model with the accepted
    effects that it keeps. Without this comparison, a set that a gate refused at the declared model
    could pass in a later round, after a worse effect was accepted.
    """
    kept, start = chosen.fitted.structure, begun.model.start
    for position in reversed(range(len(begun.model.added))):
        if begun.model.added[position].effect.name not in kept:
            start = start.minus(position)
    rest: FittedModel | None = None
    if start.added:
        (rest,) = fitter.fit(LoopStage.REFITS, [start], full_refit(fitter))
    model = rest or begun.base
    return replace(begun, model=model, prediction=predict(fitter, model))


def may_go_on(fitter: Fitter, begun: RoundStart, fitted: FittedModel, trusted: FittedModel) -> bool:
    """Return whether the search can continue with a model, which must also stay bounded."""
    if begun.has(LoopPart.BOUNDED):
        return is_usable(fitter, fitted, trusted)
    return can_be_linearised(fitter, fitted)


def _is_coloured_noise(begun: RoundStart) -> bool:
    """Return whether autocorrelated noise of the declared sigma explains the residual.

    An autoregression also follows a slow effect, such as friction in a short record. So if no sigma
    is declared, or if the residual is larger than it, candidates are refitted, and the gate
    `COLOURED_GAIN` compares them with autocorrelated noise.
    """
    residuals = begun.model.residuals
    within = begun.sigma_declared and begun.model.sse <= VERDICT.gap * len(residuals)
    return within and begun.screening.p_white > begun.settings.significance


def _curve_does_most(begun: RoundStart) -> bool:
    """Return whether a structure has a free curve or filter and closes what a claim needs.

    What it leaves is then partly its own error, so further effects would follow this error.
    """
    free = any(candidate.form.free for candidate in begun.model.added)
    closed = begun.base.sse - begun.model.sse
    return free and closed >= VERDICT.most_by_curve * (begun.base.sse - begun.floor)


def _improving(
    records: StackedRecords, begun: RoundStart, contenders: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Return the contenders with a better criterion than the accepted structure."""
    most = begun.model.criterion(records)
    return [c for c in contenders if c.criterion < most]


def _gain(records: StackedRecords, begun: RoundStart, chosen: RefittedCandidate) -> float:
    """Return the gain of the criterion, minus the penalty for the choice among the candidates."""
    penalty = _choice_penalty(begun, chosen)
    return float(begun.model.criterion(records) - chosen.criterion - penalty)


def _choice_penalty(begun: RoundStart, chosen: RefittedCandidate) -> float:
    known = len(begun.model.added)
    added = len(chosen.fitted.added) - known
    # each further effect must earn more: part of what the earlier ones leave is their own error
    return float(SELECTION.choice_price * added * (1 + known) * np.log(begun.screening.count))


def coloured_noise_explains(
    records: StackedRecords, begun: RoundStart, chosen: RefittedCandidate
) -> bool:
    """Return whether autocorrelated noise would explain as much as an effect does.

    The criterion assumes white noise, and counts every sample as independent. Process noise is
    slow, and some slow function always follows it. So both models are also compared with an
    autoregression as noise of each output, fitted to the residual that remains with the effect.
    """
    before, after = begun.model, chosen.fitted
    longest = max((len(item.times) for item in records.items), default=0)
    order = min(SELECTION.autoregression, longest // 10)
    gain = _coloured_gain(before.residuals, after.residuals, records, order)
    unknowns = (after.space.size - before.space.size) * np.log(len(after.residuals))
    return bool(gain <= unknowns + _choice_penalty(begun, chosen))


def beyond_coloured_noise(
    fitter: Fitter, begun: RoundStart, contenders: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Return the contenders that explain more than coloured noise, except functions of time.

    A drift or a wave in time can follow any disturbance of one experiment, but does not hold for
    other experiments.
    """
    return [
        c
        for c in contenders
        if not c.candidate.form.of_time_alone
        and not coloured_noise_explains(fitter.records, begun, c)
    ]


def _coloured_gain(
    before: FloatArray, after: FloatArray, records: StackedRecords, order: int
) -> float:
    """Fall of the deviance if the noise is the autoregression of the second residual.

    For a residual that is smooth up to rounding error, no autoregression of high order can be
    fitted; then a lower order is used.
    """
    for lower in range(order, 0, -1):
        try:
            noise = fit_autoregression(after, records, lower)
            return deviance(before, records, noise) - deviance(after, records, noise)
        except (ValueError, np.linalg.LinAlgError):
            continue
    return deviance(before, records) - deviance(after, records)


def _closed(begun: RoundStart, after: LeaveOneOutPrediction) -> float:
    """The closed share of the gap between the error of predictions and the noise."""
    return after.closes(begun.prediction, begun.floor, VERDICT.negligible)


def _may_leave_noise(attempt: Attempt) -> bool:
    """Return whether the remaining residual is small enough to be sensor noise."""
    return attempt.chosen.fitted.sse <= VERDICT.coloured**2 * attempt.begun.floor


def _fall(attempt: Attempt) -> float:
    return attempt.begun.model.sse - attempt.chosen.fitted.sse


def _explains_little(attempt: Attempt, fitter: Fitter) -> bool:
    """Return whether a proposal closes too little of the gap and leaves more than noise."""
    begun = attempt.begun
    if not leaves_more_than_noise(begun.model, begun.floor):
        return False
    if not attempt.predicts_better and attempt.of_few:
        return False
    return attempt.closed < begun.settings.least_gain and not _rest_is_coloured(attempt, fitter)


def _improved(current: FittedModel, grown: FittedModel) -> float:
    """Share of the experiments that fit clearly better."""
    share = 1.0 - VERDICT.negligible
    better = [
        np.sum(grown.residuals[rows] ** 2) < share * np.sum(current.residuals[rows] ** 2)
        for rows in current.space.rows
    ]
    return float(np.mean(better))


def _rest_is_coloured(attempt: Attempt, fitter: Fitter) -> bool:
    """Return whether an effect leaves only coloured noise, so that it explains all it can."""
    begun = attempt.begun
    least = VERDICT.negligible * begun.model.sse
    if not attempt.after.is_better_than(begun.prediction) or _fall(attempt) < least:
        return False
    p_white = screen(fitter, begun.settings, attempt.chosen.fitted, 90).p_white
    return p_white > begun.settings.significance
