"""The gates that a larger structure must pass to take the place of the accepted one.

Each has a name by which a setting leaves it out, a threshold, and an origin of that: "theory" names
a result, "signal" is a property of measured data or of a simulation, "setting" is a key of
`[closed_loop]`, and "benchmark" means that no theory gives it: the rates of
`scripts/closed_loop_benchmark/RESULTS.md` were measured with it. Tune it on the systems there that
say `split="tune"`, never on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.numerical_error import NUMERICAL_ERROR
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.functions_of_time import admissible
from cluster_est.closed_loop.selection.prediction import LeaveOneOutPrediction, is_usable, predict
from cluster_est.closed_loop.selection.refits import RefittedCandidate, plainest
from cluster_est.closed_loop.selection.rounds import (
    RejectionReason,
    RoundEnd,
    RoundStart,
    SelectionRound,
)
from cluster_est.closed_loop.settings import LoopPart
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression
from workers.messages import FloatArray


@dataclass(frozen=True)
class SelectionThresholds:
    """Thresholds that the best contender of a round must pass.

    Attributes
    ----------
    choice_price
        Logarithms of the number of candidates that the gain must pay for. Theory: a Bonferroni
        correction, twice the logarithm on the scale of the criterion.
    pair_price
        The same, of two effects in the place of one. Theory: the pairs are as many as the square.
    solo_gain
        Gain of the criterion with which an effect may live in a minority of the experiments.
        Benchmark.
    solo_share
        Ratio of squares below which an experiment fits clearly better. Benchmark.
    minority
        Share of the experiments that is one. By definition.
    hard
        Share of the gap to the noise that a single effect must close, or two at once are tried.
        Benchmark.
    gap
        Residual over noise, in squares, above which an effect must close a part of it. Benchmark.
    least_gap
        Share of the noise that a gap counts as at least. Benchmark.
    mostly_better
        Share of the parts left out that must be predicted better for the rest to count as noise.
        Benchmark.
    least_fall
        Share of the squares that must be explained for the same. Benchmark.
    local_minimum
        Ratio of squares below which the declared model, restarted from the new parameters, was in a
        local minimum before. Benchmark.
    autoregression
        Order of the noise that a gain is compared with. Signal: the noise of a sensor with that of
        a process on it is no autoregression of low order; the order up to which intervals look.
    """

    choice_price: float = 2.0
    pair_price: float = 4.0
    solo_gain: float = 30.0
    solo_share: float = 0.98
    minority: float = 0.5
    hard: float = 0.7
    gap: float = 1.15
    least_gap: float = 0.02
    mostly_better: float = 0.75
    least_fall: float = 0.02
    local_minimum: float = 0.97
    autoregression: int = 20


SELECTION = SelectionThresholds()


@dataclass(frozen=True)
class VerdictThresholds:
    """Thresholds of the verdict.

    Attributes
    ----------
    structure
        Standardised omnibus statistic above which structure counts as left. Benchmark.
    excess
        Residual over noise, in squares, less 1, below which nothing can be left. Benchmark.
    coloured
        Residual over the estimated noise above which what is left is no noise of a sensor, where
        no sigma is declared. Theory: a fourth difference of first-order noise with a correlation
        of 0.93 is five times too small.
    partial
        Partial autocorrelation beyond lag 1 up to which noise counts as of first order. Benchmark.
    nearly_all
        Share of the gap to the noise, in squares, that effects must close for "found". Benchmark.
    most
        The same for "partial": the error is at least halved, on training and on held-out data.
        By definition: what explains less is a hint, and no model.
    most_by_curve
        The same for "partial" with a free curve, which takes any shape: what it leaves says that
        the effect is another one. Benchmark.
    mostly_better
        Share of the parts left out that must be predicted better for the rest to count as noise.
        Benchmark.
    smooth
        p-value of the omnibus test above which a residual is not called autocorrelated. Benchmark.
    """

    structure: float = 5.0
    excess: float = 0.05
    coloured: float = 5.0
    partial: float = 0.1
    nearly_all: float = 0.98
    most: float = 0.75
    most_by_curve: float = 0.9
    mostly_better: float = 0.75
    smooth: float = 0.1


VERDICT = VerdictThresholds()


@dataclass(frozen=True)
class Attempt:
    """The best proposal of a round, and what it predicts.

    Attributes
    ----------
    begun
        The round.
    chosen, after
        The proposal, and its leave-one-out prediction.
    gain
        Of the criterion, less what the choice among the candidates must pay.
    closed
        Share of the gap between predictions and noise that it closes.
    coloured
        Autocorrelated noise would explain as much.
    """

    begun: RoundStart = field(repr=False)
    chosen: RefittedCandidate = field(repr=False)
    after: LeaveOneOutPrediction
    gain: float
    closed: float
    coloured: bool

    @property
    def of_few(self) -> bool:
        """A minority of the experiments fits clearly better, and by much."""
        current, grown = self.begun.model, self.chosen.fitted
        few = _improved(current, grown, SELECTION.solo_share) <= SELECTION.minority
        return self.gain > SELECTION.solo_gain and few

    @property
    def predicts_better(self) -> bool:
        return self.after.total < self.begun.prediction.total


@dataclass(frozen=True)
class Stop:
    """What ends a search before anything is proposed; without a part it cannot be left out."""

    part: LoopPart | None
    refuses: Callable[[RoundStart], bool]
    reason: RejectionReason
    origin: str


@dataclass(frozen=True)
class Gate:
    """What refuses the best proposal of a round.

    Attributes
    ----------
    part
        Its name.
    refuses
        Whether it does; it may simulate.
    reason
        What the summary says then.
    threshold, origin
        The number that it compares with, where it is one of its own; where it comes from.
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
        lambda begun: begun.screening.p_white > begun.settings.significance,
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
        LoopPart.CURVE_ENDS,
        lambda begun: any(candidate.form.free for candidate in begun.model.added),
        RejectionReason.FREE_CURVE,
        "by definition: what a curve leaves is partly its own error",
    ),
)
"""In the order in which they are asked."""

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
        "signal: the noise of a sensor with that of a process on it",
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
        "benchmark: the gain with which an effect may live in a minority of the experiments",
    ),
    Gate(
        LoopPart.LEAST_GAIN,
        lambda attempt, fitter: _explains_little(attempt, fitter),
        RejectionReason.LITTLE_EXPLAINED,
        SELECTION.gap,
        "setting: least_gain; benchmark: the gap from which it is asked for",
    ),
)
"""In the order in which they are asked; before them `choose` asks for `CRITERION`, `WAVES` and
`BOUNDED`, which every proposal must pass to be the best."""


def reason_to_stop(begun: RoundStart) -> RejectionReason | None:
    """Return why nothing need be refitted; None if something may be missing."""
    asked = (stop for stop in STOPS if stop.part not in begun.settings.without)
    return next((stop.reason for stop in asked if stop.refuses(begun)), None)


def first_refusal(fitter: Fitter, attempt: Attempt) -> Gate | None:
    """Return the first gate that a proposal does not pass; None if it passes all."""
    asked = (gate for gate in GATES if gate.part not in attempt.begun.settings.without)
    return next((gate for gate in asked if gate.refuses(attempt, fitter)), None)


def choose(fitter: Fitter, begun: RoundStart, proposals: Sequence[RefittedCandidate]) -> RoundEnd:
    """Return the best proposal that stays bounded, if it passes the gates.

    Parameters
    ----------
    begun
        The round.
    proposals
        Structures larger than the accepted one, refitted.
    """
    current = begun.model
    if not proposals:
        return RoundEnd(SelectionRound(begun.screening, (), RejectionReason.LITTLE_PROMISED))
    ranked = sorted(proposals, key=lambda c: c.criterion)
    most = current.criterion(fitter.records) if begun.has(LoopPart.CRITERION) else np.inf
    better = [c for c in ranked if c.criterion < most]
    stopped = {c.fitted.structure: LoopPart.CRITERION for c in ranked if c.criterion >= most}
    left = admissible(fitter, current, better) if begun.has(LoopPart.WAVES) else better
    kept = {id(c) for c in left}
    stopped |= {c.fitted.structure: LoopPart.WAVES for c in better if id(c) not in kept}
    why = RejectionReason.ONLY_WAVES if better and not left else RejectionReason.NO_IMPROVEMENT
    while left:
        chosen = plainest(left)
        if not begun.has(LoopPart.BOUNDED) or is_usable(fitter, chosen.fitted, current):
            break
        stopped[chosen.fitted.structure] = LoopPart.BOUNDED
        left = [c for c in left if c is not chosen]
    if not left:
        return RoundEnd(SelectionRound(begun.screening, tuple(ranked), why), stopped=stopped)
    after = predict(fitter, chosen.fitted)
    gain, closed = _gain(fitter.records, begun, chosen), _closed(begun, after)
    coloured = coloured_noise_explains(fitter.records, begun, chosen)
    failed = first_refusal(fitter, Attempt(begun, chosen, after, gain, closed, coloured))
    if failed is None:
        seen = SelectionRound(begun.screening, tuple(left), None, gain, closed, coloured)
        return RoundEnd(seen, chosen, after, stopped=stopped)
    stopped[chosen.fitted.structure] = failed.part
    seen = SelectionRound(begun.screening, tuple(left), failed.reason, gain, closed, coloured)
    return RoundEnd(seen, stopped=stopped)


def leaves_more_than_noise(fitted: FittedModel, floor: float) -> bool:
    """Return whether the residual of a fit is clearly larger than the noise."""
    return fitted.sse > SELECTION.gap * floor


def useful_sse(begun: RoundStart, added: int) -> float:
    """Return the sum of squares that structures of a round must come down to, to be of any use.

    With the last effect that is allowed a structure must close the least share of the gap, and as
    much of it as a claim needs. What may be the noise of sensors for its size has to close nothing,
    and a smaller structure neither: a further effect may show what it is good for.

    Parameters
    ----------
    added
        Number of effects of the structures.
    """
    settings, floor = begun.settings, begun.floor
    if added < settings.max_effects:
        return np.inf
    gate = begun.model.sse - settings.least_gain * (begun.model.sse - floor)
    return max(min(gate, _claim_sse(begun)), _near_noise_sse(begun))


def claimable_sse(begun: RoundStart, added: int) -> float:
    """Return the sum of squares above which a structure of so many effects comes to nothing.

    Where nothing can be added to it, it must close as much of the gap as a claim needs, or be the
    noise of sensors for its size.
    """
    return np.inf if added < begun.settings.max_effects else _least_claim_sse(begun)


def can_be_claimed(begun: RoundStart, fitted: FittedModel) -> bool:
    """Return whether a structure closes as much as a claim needs, or leaves sensors' noise."""
    return fitted.sse <= _least_claim_sse(begun)


def _least_claim_sse(begun: RoundStart) -> float:
    return max(_claim_sse(begun), _near_noise_sse(begun))


def _claim_sse(begun: RoundStart) -> float:
    return begun.base.sse - VERDICT.most * (begun.base.sse - begun.floor)


def _near_noise_sse(begun: RoundStart) -> float:
    near = begun.settings.near_noise if begun.sigma_declared else VERDICT.coloured
    return float(near**2 * begun.floor)


def _gain(records: StackedRecords, begun: RoundStart, chosen: RefittedCandidate) -> float:
    """Gain of the criterion, less what the choice among the candidates must pay."""
    penalty = _choice_penalty(begun, chosen)
    return float(begun.model.criterion(records) - chosen.criterion - penalty)


def _choice_penalty(begun: RoundStart, chosen: RefittedCandidate) -> float:
    known = len(begun.model.added)
    added = len(chosen.fitted.added) - known
    # each further effect must earn more: what the ones before leave is partly their own error
    return float(SELECTION.choice_price * added * (1 + known) * np.log(begun.screening.count))


def coloured_noise_explains(
    records: StackedRecords, begun: RoundStart, chosen: RefittedCandidate
) -> bool:
    """Return whether autocorrelated noise would explain as much as an effect does.

    The criterion takes noise for white, and counts as many independent samples as there are: what a
    process adds to that of the sensors is slow, and some slow function always follows it. So both
    models are compared once more with an autoregression for the noise of each output: the one of
    what the effect leaves.
    """
    before, after = begun.model, chosen.fitted
    longest = max((len(item.times) for item in records.items), default=0)
    order = min(SELECTION.autoregression, longest // 10)
    gain = _coloured_gain(before.residuals, after.residuals, records, order)
    unknowns = (after.space.size - before.space.size) * np.log(len(after.residuals))
    return bool(gain <= unknowns + _choice_penalty(begun, chosen))


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


def _closed(begun: RoundStart, after: LeaveOneOutPrediction) -> float:
    """Share of the gap between predictions and noise that is closed."""
    before, floor = begun.prediction, begun.floor
    return (before.total - after.total) / max(before.total - floor, SELECTION.least_gap * floor)


def _may_leave_noise(attempt: Attempt) -> bool:
    """Return whether what is left may be the noise of sensors for its size."""
    return attempt.chosen.fitted.sse <= VERDICT.coloured**2 * attempt.begun.floor


def _fall(attempt: Attempt) -> float:
    return attempt.begun.model.sse - attempt.chosen.fitted.sse


def _explains_little(attempt: Attempt, fitter: Fitter) -> bool:
    """Return whether a proposal closes too little of a gap, and more than noise is left of it."""
    begun = attempt.begun
    if not leaves_more_than_noise(begun.model, begun.floor):
        return False
    if not attempt.predicts_better and attempt.of_few:
        return False
    return attempt.closed < begun.settings.least_gain and not _rest_is_coloured(attempt, fitter)


def _improved(current: FittedModel, grown: FittedModel, share: float) -> float:
    """Share of the experiments that fit clearly better."""
    better = [
        np.sum(grown.residuals[rows] ** 2) < share * np.sum(current.residuals[rows] ** 2)
        for rows in current.space.rows
    ]
    return float(np.mean(better))


def _rest_is_coloured(attempt: Attempt, fitter: Fitter) -> bool:
    """Return whether an effect leaves only coloured noise, so that it did all it could."""
    begun = attempt.begun
    better = np.mean(attempt.after.squares < begun.prediction.squares)
    least = SELECTION.least_fall * begun.model.sse
    if better < SELECTION.mostly_better or _fall(attempt) < least:
        return False
    p_white = screen(fitter, begun.settings, attempt.chosen.fitted, 90).p_white
    return p_white > begun.settings.significance
