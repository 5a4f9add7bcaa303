"""The rounds of a search, the structures that they compare, and the result."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.candidates.arguments import KinematicDefinition
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

    Here the gap is the sum of squared residuals, minus the part that the noise alone would leave.

    Attributes
    ----------
    gap
        Squared residual over squared noise, above which a new effect must close a part of the gap.
        Benchmark.
    excess
        Squared residual over squared noise, minus 1. Below this value, the model counts as
        complete. Benchmark.
    coloured
        Residual over the estimated noise, if no sigma is declared. Above this value, the residual
        is not sensor noise. Theory: the noise is estimated from fourth differences; for first-order
        noise with a correlation of 0.93, this estimate is five times too small.
    negligible
        Share of the gap that is negligible. Effects that are "found" leave at most this share of
        the gap. Benchmark.
    most
        Share of the gap that effects must close for "partial". Then the error is at least halved,
        on training and on held-out data. By definition: effects that explain less are only a hint.
    most_by_curve
        The same share for "partial" with a free curve or filter. These can take any shape, so if
        they leave more, the missing effect is a different one. Benchmark.
    """

    gap: float = 1.15
    excess: float = 0.05
    coloured: float = 5.0
    negligible: float = 0.02
    most: float = 0.75
    most_by_curve: float = 0.9


VERDICT = VerdictThresholds()


class RejectionReason(enum.StrEnum):
    """The reason why a round added no effect; the summary of a run quotes its text."""

    NO_CANDIDATE = "no effect could be tried"
    NOT_SIGNIFICANT = "no candidate effect improves the fit significantly"
    COLOURED_NOISE = (
        "once the autocorrelation of the residual is taken into account, no candidate effect "
        "improves the fit significantly"
    )
    LIMIT_OF_EFFECTS = "closed_loop.max_effects allows no further effect"
    OUT_OF_REACH = (
        "the effects so far explain so little that closed_loop.max_effects such effects would not "
        "explain enough"
    )
    FREE_CURVE = (
        "a free curve or filter was added, and its own error is part of the remaining error"
    )
    LITTLE_PROMISED = (
        "of the candidates with which the model can be simulated, none is expected to explain "
        "enough of the residual"
    )
    NO_IMPROVEMENT = (
        "no candidate improves the fit, apart from those with which the simulation does not stay "
        "bounded"
    )
    ONLY_WAVES = (
        "the only candidates that improve the fit are sinusoids or drifts in time, and each of "
        "them lasts too few periods, is at a resonance of the model, or differs between experiments"
    )
    REFITS = "the added effects do not improve the prediction of data that were left out of the fit"
    STRENGTHS = "according to the data, the strengths of the added effects may be zero"
    FUNCTIONS_OF_TIME = "apart from functions of time, no effect could be tried"
    LITTLE_GAIN = "the fit does not improve significantly, given the number of candidates"
    COLOURED_GAIN = "autocorrelated noise would explain the residual equally well"
    NOT_PREDICTED = "the prediction of data that were left out of the fit does not improve"
    NUMERICAL_ERROR = "it improves the fit by no more than the numerical error of the solver could"
    LITTLE_EXPLAINED = "it removes too little of the squared error above the noise"


@dataclass(frozen=True)
class SelectionRound:
    """One round: the screening of candidates, and its outcome.

    Attributes
    ----------
    screening
        The screening of all candidates at the accepted structure.
    contenders
        The candidates that were refitted.
    why
        The reason why no effect was added; None if one was added.
    gain
        Improvement of the criterion by the best contender.
    closed
        Share of the gap to the noise that the best contender closes.
    coloured
        Whether autocorrelated noise would explain as much as the winner; if no contender won, as
        much as each contender.
    """

    screening: ScreeningResult = field(repr=False)
    contenders: tuple[RefittedCandidate, ...] = field(repr=False)
    why: RejectionReason | None
    gain: float = np.nan
    closed: float = np.nan
    coloured: bool = False


@dataclass(frozen=True)
class RoundStart:
    """The structure to which a round tries to add an effect.

    Attributes
    ----------
    base
        The declared model, fitted.
    model, prediction
        The accepted structure, fitted, and its leave-one-out prediction.
    screening
        The screening of all candidates at that structure.
    floor
        Sum of squares of the noise alone.
    numerical
        Decrease of the sum of squares that the numerical error of the solver could cause.
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
        """Return the criterion and the sum of squares below which a refit is useful."""
        return PruningBound(criterion, sse) if self.has(LoopPart.PRUNING) else UNPRUNED


@dataclass(frozen=True)
class RoundEnd:
    """The end of a round.

    Attributes
    ----------
    won, prediction
        The structure that passed all gates, and its prediction; None if nothing was added.
    compared
        All structures that were refitted.
    stopped
        The gate that stopped each structure.
    """

    seen: SelectionRound
    won: RefittedCandidate | None = None
    prediction: LeaveOneOutPrediction | None = None
    compared: tuple[RefittedCandidate, ...] = field(default=(), repr=False)
    stopped: Mapping[frozenset[str], LoopPart] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class ComparedStructure:
    """A set of effects with which the model was refitted: a row of structures.parquet.

    Attributes
    ----------
    step
        The round that refitted it.
    effects
        Their labels, in the order in which they were added.
    criterion
        Bayesian information criterion, minus that of the declared model.
    closed
        Share of the gap between error and noise that the set closes on the training experiments;
        NaN if the declared model leaves no gap.
    converged
        Whether the refit was continued to convergence. Refits that are clearly worse are not.
    accepted
        Whether the set passed all gates, or remained of such a set after effects were dropped.
    relative_steps
        Number of solver steps, divided by that of the declared model; NaN if it is not known.
    probability
        Probability of the set among all that were compared; NaN if it is not known.
    chosen
        Share of resamplings of the experiments in which the set is the best; NaN if it is not
        known.
    move
        Name (as in `closed_loop.without`) of the part of the search that proposed the set; "" if
        the set was compared with the answer after the search.
    stopped_by
        Name of the gate that refused the set; "" if another set was better.
    left_out, held_out
        Root mean square error of cross-validation, in units of the residuals, and of the held-out
        experiments over their noise; NaN if the search did not accept the set.
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
    """An accepted structure after its fit; `rounds` is the number of rounds that led to it."""

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
        The declared model, and the model with all added effects.
    base_prediction, prediction
        Leave-one-out predictions of both models.
    steps, findings
        The rounds, and the evidence for the candidates of all rounds.
    noise : (outputs,)
        Noise of each output, in the unit of the residuals.
    path
        The compared structures in the order of the rounds, the best one of each round first.
    accepted
        The structures that passed the gates, or that remained after effects were dropped. The
        first one is the declared model.
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

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites that were searched in any round."""
        return tuple(dict.fromkeys(s for each in self.steps for s in each.screening.ranking.sites))

    @property
    def definitions(self) -> tuple[KinematicDefinition, ...]:
        """The equations that counted as definitions in all rounds; none if the user chose sites."""
        if self.settings.sites or not self.steps:
            return ()
        first = self.steps[0].screening.ranking.definitions
        return tuple(each for each in first if f"der({each.state})" not in self.sites)


def leaves_more_than_noise(fitted: FittedModel, floor: float) -> bool:
    """Return whether the residual of a fit is clearly larger than the noise."""
    return fitted.sse > VERDICT.gap * floor


def useful_sse(begun: RoundStart, added: int) -> float:
    """Return the largest sum of squares with which a structure of `added` effects is useful.

    A structure with the largest allowed number of effects must close `least_gain` of the gap to the
    noise, and also the share of the gap that a claim requires. This does not apply if its residual
    is small enough to be sensor noise. A claim must be in reach of a smaller structure.
    """
    settings, floor = begun.settings, begun.floor
    if added < settings.max_effects:
        return _sse_in_reach(begun, added) if begun.has(LoopPart.OUT_OF_REACH) else np.inf
    gate = begun.model.sse - settings.least_gain * (begun.model.sse - floor)
    return max(min(gate, _claim_sse(begun)), _near_noise_sse(begun))


def out_of_reach(begun: RoundStart) -> bool:
    """Return whether further effects cannot be expected to lead to a claim; see `_sse_in_reach`."""
    return begun.model.sse > _sse_in_reach(begun, len(begun.model.added))


def _sse_in_reach(begun: RoundStart, added: int) -> float:
    """Return the sum of squares up to which a claim is in reach of a structure of `added` effects.

    The best effects are added first, so that each closes no more of the gap than those before it.
    A search with at most N effects may thus lead to a claim only if n of them close at least n / N
    of the share that a claim requires. For sets of directions this holds in the same degree as the
    explained squares are submodular: A. Das, D. Kempe, Submodular meets spectral, ICML 2011,
    arXiv:1102.3975. Two effects that explain much only together are tried together.
    """
    share = min(added / begun.settings.max_effects, 1.0)
    return begun.base.sse - share * (begun.base.sse - claimable_sse(begun))


def can_be_claimed(begun: RoundStart, fitted: FittedModel) -> bool:
    """Return whether a structure closes enough of the gap, or its residual may be sensor noise."""
    return fitted.sse <= claimable_sse(begun)


def may_leave_noise(begun: RoundStart, fitted: FittedModel) -> bool:
    """Return whether the residual of a structure may be sensor noise, white or coloured.

    It may be sensor noise if it is within the declared sigmas, or close to its own white part.
    """
    within = begun.sigma_declared and fitted.sse <= VERDICT.gap * len(fitted.residuals)
    return within or fitted.sse <= _near_noise_sse(begun)


def claimable_sse(begun: RoundStart) -> float:
    """Return the sum of squares above which a structure cannot be claimed; see `can_be_claimed`."""
    return max(_claim_sse(begun), _near_noise_sse(begun))


def _claim_sse(begun: RoundStart) -> float:
    return begun.base.sse - VERDICT.most * (begun.base.sse - begun.floor)


def _near_noise_sse(begun: RoundStart) -> float:
    near = begun.settings.near_noise if begun.sigma_declared else VERDICT.coloured
    return float(near**2 * begun.floor)


def without_search(fitter: Fitter, settings: LoopSettings, base: FittedModel) -> SelectionResult:
    """Return a result for the declared model if there is no search for effects."""
    nothing = LeaveOneOutPrediction(np.zeros(0))
    noise = noise_of(fitter, base.residuals)
    return SelectionResult(base, base, nothing, nothing, {}, (), (), noise, settings)


def evidence_of_round(
    records: StackedRecords, current: FittedModel, end: RoundEnd, number: int
) -> list[CandidateEvidence]:
    """Return the candidates of a round, each with the last stage that it reached."""
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
    """Return the candidates, with the single effect that replaced all others marked as accepted.

    `first` are the candidates at the declared model from which this effect was chosen.
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
    """Return a candidate's evidence; a finer curve has the evidence of the coarse curve."""
    site, form, variables = str(candidate.site), candidate.form, candidate.effect.variables
    there = [each for each in found if (each.site, each.variables) == (site, variables)]
    own = [each for each in there if each.form == form.name]
    coarse = [each for each in there if form.finer_than and each.family == form.family]
    return next((replace(each, form=form.name) for each in (*own, *coarse)), None)


def compared_structures(
    records: StackedRecords, base: FittedModel, end: RoundEnd, floor: float, step: int
) -> list[ComparedStructure]:
    """Return the structures of a round, the best first; for `floor` see `RoundStart`."""
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
    """Return the row of an accepted structure; see `compared_structures`."""
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
