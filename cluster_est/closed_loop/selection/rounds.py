"""The rounds of a forward selection, and its result."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.screening.evidence import CandidateEvidence
from cluster_est.closed_loop.screening.screen import ScreeningResult
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.refine import RefittedCandidate
from cluster_est.closed_loop.selection.revise import Rivals
from cluster_est.closed_loop.workbench import FittedModel


class RejectionReason(enum.StrEnum):
    """The reason why a round added nothing; its text is what the summary says."""

    NO_CANDIDATE = "no effect could be tried"
    NOT_SIGNIFICANT = "nothing significant"
    COLOURED_NOISE = "coloured noise"
    LIMIT_OF_EFFECTS = "limit of effects"
    NO_IMPROVEMENT = "no candidate improves the fit and stays bounded"
    LITTLE_GAIN = "the gain does not pay for the choice among so many candidates"
    NOT_PREDICTED = "left-out experiments are not predicted better"
    LITTLE_EXPLAINED = "it explains too little of what is missing"


@dataclass(frozen=True)
class SelectionRound:
    """One round: the screening at a model, and its outcome.

    `why` is the reason why nothing was added; None where something was. `gain` is that of the
    criterion, `closed` the share of the gap to the noise that was closed.
    """

    screening: ScreeningResult = field(repr=False)
    contenders: tuple[RefittedCandidate, ...] = field(repr=False)
    why: RejectionReason | None
    gain: float = np.nan
    closed: float = np.nan


@dataclass(frozen=True)
class SelectionResult:
    """The end of a forward selection.

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
