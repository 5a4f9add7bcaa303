"""The rounds of a search, what they have compared, and the result."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.output_noise import noise_of
from cluster_est.closed_loop.screening.screen import CandidateEvidence, ScreeningResult, findings
from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.linear_model import UNPRUNED, PruningBound
from cluster_est.closed_loop.selection.refits import RefittedCandidate, Rivals
from cluster_est.closed_loop.settings import CandidateStage, LoopPart, LoopSettings
from cluster_est.statistics.records import StackedRecords


@dataclass(frozen=True)
class VerdictThresholds:
    """Thresholds of a claim and of the verdict.

    Attributes
    ----------
    gap
        Residual over noise, in squares, above which an effect must close a part of it. Benchmark.
    excess
        Residual over noise, in squares, less 1, below which nothing can be left. Benchmark.
    coloured
        Residual over the estimated noise above which what is left is no noise of a sensor, where
        no sigma is declared. Theory: a fourth difference of first-order noise with a correlation
        of 0.93 is five times too small.
    negligible
        Share of squares that counts as nothing. Effects that are "found" leave no more of the gap
        to the noise. Benchmark.
    most
        Share of the gap that effects must close for "partial": the error is at least halved, on
        training and on held-out data. By definition: what explains less is a hint, and no model.
    most_by_curve
        The same for "partial" with a free curve or filter, which takes any shape: what it leaves
        says that the effect is another one. Benchmark.
    """

    gap: float = 1.15
    excess: float = 0.05
    coloured: float = 5.0
    negligible: float = 0.02
    most: float = 0.75
    most_by_curve: float = 0.9


VERDICT = VerdictThresholds()


class RejectionReason(enum.StrEnum):
    """The reason why a round added nothing; its text is what the summary says."""

    NO_CANDIDATE = "no effect could be tried"
    NOT_SIGNIFICANT = "nothing significant"
    COLOURED_NOISE = "coloured noise"
    LIMIT_OF_EFFECTS = "limit of effects"
    FREE_CURVE = (
        "a free curve or filter was added, and its own error is part of the remaining error"
    )
    LITTLE_PROMISED = "no candidate that can be simulated is expected to explain enough"
    NO_IMPROVEMENT = "no candidate improves the fit and stays bounded"
    ONLY_WAVES = (
        "the only candidates that help are sinusoids or drifts in time, each seen too briefly, at "
        "a resonance of the model, or different in each experiment"
    )
    REFITS = "the added effects do not improve the prediction of parts that were left out"
    STRENGTHS = "the data allow the strengths of the added effects to be zero"
    FUNCTIONS_OF_TIME = (
        "drifts or sinusoids in time would close a part of the gap, as with any slow "
        "disturbance, and leave more than noise"
    )
    LITTLE_GAIN = "the gain is not significant, given the number of candidates"
    COLOURED_GAIN = "autocorrelated noise would explain as much"
    NOT_PREDICTED = "the prediction of left-out data does not improve"
    NUMERICAL_ERROR = "it explains no more than the error of the solver could"
    LITTLE_EXPLAINED = "it explains too little of the gap"


@dataclass(frozen=True)
class SelectionRound:
    """One round: the screening at a model, and its outcome.

    `why` nothing was added is None where something was. `gain` is that of the criterion, `closed`
    the share of the gap to the noise that was closed, `coloured` whether autocorrelated noise would
    explain as much as the contender that won, or as each one where none did.
    """

    screening: ScreeningResult = field(repr=False)
    contenders: tuple[RefittedCandidate, ...] = field(repr=False)
    why: RejectionReason | None
    gain: float = np.nan
    closed: float = np.nan
    coloured: bool = False


@dataclass(frozen=True)
class RoundStart:
    """The structure that a round begins with, and must improve on.

    Attributes
    ----------
    base
        The declared model, fitted.
    model, prediction
        The accepted structure, fitted, and its leave-one-out prediction.
    screening
        Of all candidates at that model.
    floor
        Sum of squares that the noise alone would leave.
    numerical
        Fall of the sum of squares that an effect could owe to the error of the solver.
    """

    base: FittedModel = field(repr=False)
    model: FittedModel = field(repr=False)
    prediction: LeaveOneOutPrediction = field(repr=False)
    screening: ScreeningResult = field(repr=False)
    floor: float
    settings: LoopSettings
    sigma_declared: bool
    numerical: float = 0.0

    def has(self, part: LoopPart) -> bool:
        """Return whether a part of the search is not left out."""
        return part not in self.settings.without

    def bound(self, criterion: float = np.inf, sse: float = np.inf) -> PruningBound:
        """Return what a refit must come down to, to be of any use."""
        return PruningBound(criterion, sse) if self.has(LoopPart.PRUNING) else UNPRUNED


@dataclass(frozen=True)
class RoundEnd:
    """The end of a round.

    Attributes
    ----------
    won, prediction
        The structure that passed, and its prediction; None where nothing was added.
    compared
        All structures that were refitted.
    stopped
        By structure, the gate that stopped it.
    """

    seen: SelectionRound
    won: RefittedCandidate | None = None
    prediction: LeaveOneOutPrediction | None = None
    compared: tuple[RefittedCandidate, ...] = field(default=(), repr=False)
    stopped: Mapping[frozenset[str], LoopPart] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class ComparedStructure:
    """A set of effects that was refitted: a row of structures.parquet.

    Attributes
    ----------
    step
        The round that refitted it.
    effects
        Their labels, in the order in which they were added.
    criterion
        Bayesian information criterion, less that of the declared model.
    closed
        Share of the gap between error and noise that it closes on the training experiments; NaN
        where the declared model leaves none.
    converged
        It was refitted to convergence; the others fell behind before.
    accepted
        It passed every gate, or is what was left of one that did once effects were dropped.
    relative_steps
        Steps of the solver over those of the declared model; NaN where they are not counted.
    probability
        Of the set among all that were compared; NaN where that is not known.
    chosen
        Share of the draws of the experiments in which the set is the best one; NaN likewise.
    move
        The part of the search that proposed it, by its name in `closed_loop.without`.
    stopped_by
        The gate that it did not pass, by the same; empty where it was not the best of its round.
    left_out, held_out
        Root mean squares, in the units of residuals, of what refits without each part predict of
        it, and of held-out experiments over their noise, where the search accepted it; else NaN.
    """

    step: int
    effects: tuple[str, ...]
    criterion: float
    closed: float
    converged: bool
    accepted: bool
    relative_steps: float = np.nan
    probability: float = np.nan
    chosen: float = np.nan
    move: str = ""
    stopped_by: str = ""
    left_out: float = np.nan
    held_out: float = np.nan


@dataclass(frozen=True)
class AcceptedStructure:
    """A structure that was accepted, fitted; `rounds` counts those that led to it."""

    model: FittedModel = field(repr=False)
    prediction: LeaveOneOutPrediction
    rivals: Rivals = field(default_factory=dict, repr=False)
    rounds: int = 0


@dataclass(frozen=True)
class SelectionResult:
    """The end of a search.

    Attributes
    ----------
    base, current
        The declared model, and the one with all effects that were added.
    base_prediction, prediction
        Leave-one-out predictions of both.
    steps, findings
        Of all rounds.
    noise : (outputs,)
        In units of the residuals.
    path
        The structures that were compared, in the order of the rounds, the best of each first.
    accepted
        The structures that passed the gates, and what was left of them once effects were dropped,
        the declared model first.
    """

    base: FittedModel = field(repr=False)
    current: FittedModel = field(repr=False)
    base_prediction: LeaveOneOutPrediction = field(repr=False)
    prediction: LeaveOneOutPrediction = field(repr=False)
    rivals: Rivals = field(repr=False)
    steps: tuple[SelectionRound, ...] = field(repr=False)
    findings: tuple[CandidateEvidence, ...] = field(repr=False)
    noise: np.ndarray
    settings: LoopSettings
    path: tuple[ComparedStructure, ...] = field(default=(), repr=False)
    accepted: tuple[AcceptedStructure, ...] = field(default=(), repr=False)

    @property
    def last(self) -> SelectionRound:
        return self.steps[-1]


def leaves_more_than_noise(fitted: FittedModel, floor: float) -> bool:
    """Return whether the residual of a fit is clearly larger than the noise."""
    return fitted.sse > VERDICT.gap * floor


def useful_sse(begun: RoundStart, added: int) -> float:
    """Return the sum of squares that structures of so many effects must come down to, to be of use.

    With the last effect that is allowed a structure must close the least share of the gap, and as
    much of it as a claim needs. What may be the noise of sensors for its size has to close nothing,
    and a smaller structure neither: a further effect may show what it is good for.
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


def may_leave_noise(begun: RoundStart, fitted: FittedModel) -> bool:
    """Return whether what a structure leaves may be the noise of sensors, white or not.

    It is as small as sigmas that are declared, or near the part of it that is white.
    """
    within = begun.sigma_declared and fitted.sse <= VERDICT.gap * len(fitted.residuals)
    return within or fitted.sse <= _near_noise_sse(begun)


def _least_claim_sse(begun: RoundStart) -> float:
    return max(_claim_sse(begun), _near_noise_sse(begun))


def _claim_sse(begun: RoundStart) -> float:
    return begun.base.sse - VERDICT.most * (begun.base.sse - begun.floor)


def _near_noise_sse(begun: RoundStart) -> float:
    near = begun.settings.near_noise if begun.sigma_declared else VERDICT.coloured
    return float(near**2 * begun.floor)


def without_search(fitter: Fitter, settings: LoopSettings, base: FittedModel) -> SelectionResult:
    """The declared model alone, where no effect was looked for."""
    nothing = LeaveOneOutPrediction(np.zeros(0))
    noise = noise_of(fitter, base.residuals)
    return SelectionResult(base, base, nothing, nothing, {}, (), (), noise, settings)


def evidence_of_round(
    records: StackedRecords, current: FittedModel, end: RoundEnd, number: int
) -> list[CandidateEvidence]:
    """Return the candidates of a round, with how far each came."""
    found = findings(end.seen.screening.ranking, current, number)
    base = current.criterion(records)
    reached = [
        (c, CandidateStage.REFITTED)
        for c in end.compared
        if c.fitted.structure - {c.candidate.effect.name} == current.structure
    ]
    if end.won is not None:
        reached.append((end.won, CandidateStage.ACCEPTED))
    for contender, stage in reached:
        for candidate in contender.fitted.added:
            known = _evidence_of(found.values(), candidate)
            if known is not None:
                known = replace(known, stage=stage, criterion=contender.criterion - base)
                found[candidate.effect.name] = known
    return list(found.values())


def with_single(
    seen: Sequence[CandidateEvidence],
    first: Iterable[CandidateEvidence],
    won: RefittedCandidate,
    criterion: float,
) -> list[CandidateEvidence]:
    """Return the candidates, with the one that took the place of all effects as accepted.

    `first` are those of the ranking that it was chosen from, at the declared model.
    """
    known = _evidence_of(first, won.candidate)
    if known is None:
        return list(seen)
    accepted = replace(known, stage=CandidateStage.ACCEPTED, criterion=criterion)
    own = accepted.step, accepted.site, accepted.form, accepted.variables
    others = (each for each in seen if (each.step, each.site, each.form, each.variables) != own)
    return [accepted, *others]


def _evidence_of(
    found: Iterable[CandidateEvidence], candidate: EffectCandidate
) -> CandidateEvidence | None:
    """That of a candidate; of a finer curve, that of the one with which its place was screened."""
    site, form, variables = str(candidate.site), candidate.form, candidate.effect.variables
    there = [each for each in found if (each.site, each.variables) == (site, variables)]
    own = [each for each in there if each.form == form.name]
    coarse = [each for each in there if form.finer_than and each.family == form.family]
    return next((replace(each, form=form.name) for each in (*own, *coarse)), None)


def compared_structures(
    records: StackedRecords, base: FittedModel, end: RoundEnd, floor: float, step: int
) -> list[ComparedStructure]:
    """The structures of a round, the best first; `floor` is what the noise alone would leave."""
    return [
        replace(
            compared_structure(records, base, contender.fitted, floor, step),
            converged=contender.full,
            accepted=contender is end.won,
            move=contender.move or "",
            stopped_by=end.stopped.get(contender.fitted.structure, ""),
        )
        for contender in sorted(end.compared, key=lambda c: c.criterion)
    ]


def compared_structure(
    records: StackedRecords,
    base: FittedModel,
    fitted: FittedModel,
    floor: float,
    step: int,
    move: str = "",
) -> ComparedStructure:
    """A structure that was accepted, as a row; see `compared_structures`."""
    gap = base.sse - floor
    return ComparedStructure(
        step=step,
        effects=tuple(candidate.label for candidate in fitted.added),
        criterion=fitted.criterion(records) - base.criterion(records),
        closed=(base.sse - fitted.sse) / gap if gap > 0.0 else np.nan,
        converged=True,
        accepted=True,
        relative_steps=fitted.steps / base.steps if base.steps and fitted.steps else np.nan,
        move=move,
    )
