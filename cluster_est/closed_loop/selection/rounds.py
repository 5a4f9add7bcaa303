"""The rounds of a beam search, and its result."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.measured_noise import noise_of
from cluster_est.closed_loop.screening.evidence import CandidateEvidence
from cluster_est.closed_loop.screening.screen import ScreeningResult
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate, Rivals
from cluster_est.closed_loop.selection.refinement.visited_models import VisitedModels
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench


class RejectionReason(enum.StrEnum):
    """The reason why a round added nothing; its text is what the summary says."""

    NO_CANDIDATE = "no effect could be tried"
    NOT_SIGNIFICANT = "nothing significant"
    COLOURED_NOISE = "coloured noise"
    LIMIT_OF_EFFECTS = "limit of effects"
    FREE_CURVE = "a free curve was added, whose own error is part of what is left"
    LITTLE_PROMISED = "no candidate that can be simulated promises to explain enough"
    NO_IMPROVEMENT = "no candidate improves the fit and stays bounded"
    ONLY_WAVES = (
        "the only candidates that help are sinusoids or drifts in time, each seen too briefly, at "
        "a resonance of the model, or different in each experiment"
    )
    FUNCTIONS_OF_TIME = (
        "drifts or waves in time would close a part of the gap, as they do with any slow "
        "disturbance, and leave more than noise"
    )
    LITTLE_GAIN = "the gain is not significant among so many candidates"
    COLOURED_GAIN = "noise that is autocorrelated would explain as much"
    NOT_PREDICTED = "what was left out to be predicted is not predicted better"
    NUMERICAL_ERROR = "it explains no more than the error of the solver and its steps may be"
    LITTLE_EXPLAINED = "it explains too little of what is missing"


@dataclass(frozen=True)
class SelectionRound:
    """One round: the screening at a model, and its outcome.

    `why` is the reason why nothing was added; None where something was. `gain` is that of the
    criterion, `closed` the share of the gap to the noise that was closed, `coloured` whether
    autocorrelated noise would explain as much as the best contender did.
    """

    screening: ScreeningResult = field(repr=False)
    contenders: tuple[RefittedCandidate, ...] = field(repr=False)
    why: RejectionReason | None
    gain: float = np.nan
    closed: float = np.nan
    coloured: bool = False


@dataclass(frozen=True)
class RoundStart:
    """The structure that a round must improve on, and those that it grows from.

    Attributes
    ----------
    base
        The declared model, fitted.
    model, prediction
        The accepted structure, fitted, and its leave-one-out prediction.
    screening
        Of all candidates at that model.
    visited
        The models that the search has added effects to.
    floor
        Sum of squares that the noise alone would leave.
    beside
        The structures that it was compared with in the round before.
    numerical
        Fall of the sum of squares that an effect could owe to the error of the solver.
    """

    base: FittedModel = field(repr=False)
    model: FittedModel = field(repr=False)
    prediction: LeaveOneOutPrediction = field(repr=False)
    screening: ScreeningResult = field(repr=False)
    visited: VisitedModels = field(repr=False)
    floor: float
    beside: tuple[RefittedCandidate, ...] = field(default=(), repr=False)
    numerical: float = 0.0


@dataclass(frozen=True)
class RoundEnd:
    """The end of a round.

    Attributes
    ----------
    seen
        What it looked at, and the reason why nothing was added.
    won, prediction
        The structure that passed, and its prediction; None where nothing was added.
    compared
        All structures that were refitted.
    """

    seen: SelectionRound
    won: RefittedCandidate | None = None
    prediction: LeaveOneOutPrediction | None = None
    compared: tuple[RefittedCandidate, ...] = field(default=(), repr=False)


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
        It passed every gate, or is what revision made of one that did.
    relative_steps
        Steps of the solver over those of the declared model; NaN where they are not counted.
    probability
        Of the set among all that were compared; NaN where that is not known.
    chosen
        Share of the draws of the experiments in which the set is the best one; NaN likewise.
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


@dataclass(frozen=True)
class SelectionResult:
    """The end of a beam search.

    Attributes
    ----------
    base, current
        The declared model, and the one with all effects that were added.
    base_prediction, prediction
        Leave-one-out predictions of both.
    rivals
        For each added effect, by name, the contenders that it won against.
    steps, findings
        Of all rounds.
    noise
        Of each output, in units of its residual.
    path
        The structures that were compared, in the order of the rounds, the best of each first.
    """

    base: FittedModel = field(repr=False)
    current: FittedModel = field(repr=False)
    base_prediction: LeaveOneOutPrediction = field(repr=False)
    prediction: LeaveOneOutPrediction = field(repr=False)
    rivals: Rivals = field(repr=False)
    steps: tuple[SelectionRound, ...] = field(repr=False)
    findings: tuple[CandidateEvidence, ...] = field(repr=False)
    noise: np.ndarray
    path: tuple[ComparedStructure, ...] = field(default=(), repr=False)

    @property
    def last(self) -> SelectionRound:
        return self.steps[-1]


def without_search(workbench: LoopWorkbench, base: FittedModel) -> SelectionResult:
    """The declared model alone, where no effect was looked for."""
    nothing = LeaveOneOutPrediction(np.zeros(0))
    noise = noise_of(workbench, base.residuals)
    return SelectionResult(base, base, nothing, nothing, {}, (), (), noise)
