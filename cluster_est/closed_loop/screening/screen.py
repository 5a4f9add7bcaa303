"""Screening: whether any candidate, or any smooth structure, is more than noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cluster_est.closed_loop.screening.evidence import CandidateEvidence, CandidateStage
from cluster_est.closed_loop.screening.ranking import CandidateRanking, rank
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.residual_tests import structure
from cluster_est.statistics.score import ScoreTests, family_wise
from cluster_est.statistics.whiteness import SmoothnessTest
from workers.messages import FloatArray


@dataclass(frozen=True)
class ScreeningResult:
    """All candidates against the residual of a fit, tested.

    Attributes
    ----------
    ranking
        Of the candidates.
    structure, structure_white
        Tests for any smooth structure, before and after whitening.
    p, p_white
        Family-wise p-values; where not all candidates were looked at, by Bonferroni's inequality
        times `CandidateRanking.unseen`.
    """

    ranking: CandidateRanking = field(repr=False)
    structure: SmoothnessTest
    structure_white: SmoothnessTest
    p: float
    p_white: float

    @property
    def count(self) -> int:
        """Different candidates that the parameters do not confound."""
        return self.ranking.count


def screen(workbench: LoopWorkbench, fitted: FittedModel, step: int) -> ScreeningResult:
    """Rank every candidate at a fit, and test the best.

    Parameters
    ----------
    workbench, fitted
        Where, and what is screened.
    step
        The number of the round: its random generators are its own.
    """
    ranking = rank(workbench, fitted)
    streams = [workbench.generator(10 * step + stream) for stream in (3, 4)]
    draws = workbench.settings.draws

    def best(scores: ScoreTests, generator: np.random.Generator) -> float:
        return min(ranking.unseen * family_wise(scores, generator, draws).p, 1.0)

    tests: list[Callable[[], Any]] = [
        lambda: structure(ranking.residual, ranking.records),
        lambda: structure(ranking.residual_white, ranking.records),
        lambda: best(ranking.plain, streams[0]),
        lambda: best(ranking.white, streams[1]),
    ]
    found = []
    for done, test in enumerate(tests):
        workbench.runner.display.step(LoopStage.TESTS.value, done, len(tests))
        found.append(test())
    return ScreeningResult(ranking, *found)


def findings(
    ranking: CandidateRanking, fitted: FittedModel, step: int
) -> dict[str, CandidateEvidence]:
    """The best trial of each candidate as a finding, by the effect's name."""
    found: dict[str, CandidateEvidence] = {}
    scores = ranking.plain
    matrix = fitted.jacobian[ranking.rows]
    for i in np.argsort(-scores.statistics, kind="stable").tolist():
        candidate = ranking.trials[i].candidate
        if candidate.effect.name in found:
            continue
        aside = scores.df[i] == 0
        found[candidate.effect.name] = CandidateEvidence(
            step=step,
            site=str(candidate.site),
            form=candidate.form.name,
            family=candidate.form.family,
            variables=candidate.effect.variables,
            statistic=float(scores.statistics[i]),
            freedom=int(scores.df[i]),
            log_p=float(scores.log_p[i]),
            explained=float(scores.explained[i]),
            distinct=float(scores.ratio[i]),
            stage=CandidateStage.SET_ASIDE if aside else CandidateStage.SCREENED,
            confounded_with=_confounding_parameter(matrix, ranking.columns[i], fitted)
            if aside
            else "",
        )
    return found


def _confounding_parameter(matrix: FloatArray, column: FloatArray, fitted: FittedModel) -> str:
    """The declared parameter whose sensitivity is most like a direction."""
    direction = column[:, 0]
    norms = np.linalg.norm(matrix, axis=0) * np.linalg.norm(direction)
    if not norms.size or not norms.max() > 0.0:
        return ""
    cosines = np.abs(direction @ matrix) / np.where(norms > 0.0, norms, np.inf)
    return fitted.space.unknowns[int(np.argmax(cosines))].label


def refreshed(
    finding: CandidateEvidence, stage: CandidateStage, criterion: float = np.nan
) -> CandidateEvidence:
    """A finding that has come a stage further."""
    return replace(finding, stage=stage, criterion=criterion)
