"""The statistical and physical choices of a closed loop, grouped by the step that makes them.

Each says where it comes from. "Theory" names a result; "signal" is a property of measured data or
of a simulation; "benchmark" means that no theory gives it, and that the rates of
`scripts/closed_loop_benchmark/RESULTS.md` were measured with it: tune it on the systems there that
say `split="tune"`, never on the others. Guards against rounding stand where they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from cluster_est.closed_loop.thresholds.evidence import (
    AcceptanceThresholds,
    SelectionThresholds,
    VerdictThresholds,
    WaveThresholds,
)
from cluster_est.closed_loop.thresholds.preparation import (
    DeclaredModelThresholds,
    NumericalErrorThresholds,
    PreparationThresholds,
)
from cluster_est.closed_loop.thresholds.screening import (
    CandidateThresholds,
    PlaceThresholds,
    ScreeningThresholds,
)
from cluster_est.closed_loop.thresholds.search import (
    BeamThresholds,
    PairThresholds,
    RefinementThresholds,
    RevisionThresholds,
)

__all__ = [
    "AcceptanceThresholds",
    "BeamThresholds",
    "CandidateThresholds",
    "DeclaredModelThresholds",
    "LoopThresholds",
    "NumericalErrorThresholds",
    "PairThresholds",
    "PlaceThresholds",
    "PreparationThresholds",
    "RefinementThresholds",
    "RevisionThresholds",
    "ScreeningThresholds",
    "SelectionThresholds",
    "VerdictThresholds",
    "WaveThresholds",
]


@dataclass(frozen=True)
class LoopThresholds:
    """All thresholds of a closed loop, by step."""

    preparation: PreparationThresholds = field(default_factory=PreparationThresholds)
    declared_model: DeclaredModelThresholds = field(default_factory=DeclaredModelThresholds)
    numerical_error: NumericalErrorThresholds = field(default_factory=NumericalErrorThresholds)
    candidates: CandidateThresholds = field(default_factory=CandidateThresholds)
    screening: ScreeningThresholds = field(default_factory=ScreeningThresholds)
    places: PlaceThresholds = field(default_factory=PlaceThresholds)
    refinement: RefinementThresholds = field(default_factory=RefinementThresholds)
    pairs: PairThresholds = field(default_factory=PairThresholds)
    beam: BeamThresholds = field(default_factory=BeamThresholds)
    revision: RevisionThresholds = field(default_factory=RevisionThresholds)
    selection: SelectionThresholds = field(default_factory=SelectionThresholds)
    waves: WaveThresholds = field(default_factory=WaveThresholds)
    acceptance: AcceptanceThresholds = field(default_factory=AcceptanceThresholds)
    verdict: VerdictThresholds = field(default_factory=VerdictThresholds)
