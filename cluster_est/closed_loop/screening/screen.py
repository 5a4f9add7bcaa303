"""Screening: the direction of every candidate against the residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.screening.directions import CandidatePoint, directions
from cluster_est.closed_loop.screening.evidence import CandidateEvidence, CandidateStage
from cluster_est.closed_loop.screening.probe import probe
from cluster_est.closed_loop.statistics.omnibus import OmnibusTest, omnibus
from cluster_est.closed_loop.statistics.projection import OrthogonalProjection
from cluster_est.closed_loop.statistics.records import StackedRecords, thinned
from cluster_est.closed_loop.statistics.score import ScoreTests, family_wise, score
from cluster_est.closed_loop.statistics.whitening import fit_autoregression, whiten
from cluster_est.closed_loop.thresholds import ScreeningThresholds
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.errors import DataError
from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class ScreeningResult:
    """All candidates against the residual of a fit.

    Attributes
    ----------
    trials
        Candidates at the points of their grids.
    columns
        The direction of each trial, (kept residuals, width).
    rows
        Indices of the residuals that were kept.
    plain, white
        Scores against the residual as it is, and after both were whitened by an autoregression.
    omnibus, omnibus_white
        Tests for any smooth structure, before and after whitening.
    p, p_white
        Family-wise p-values.
    column_penalty
        See `ScreeningThresholds`.
    """

    trials: tuple[CandidatePoint, ...]
    columns: tuple[FloatArray, ...] = field(repr=False)
    rows: IntArray = field(repr=False)
    plain: ScoreTests = field(repr=False)
    white: ScoreTests = field(repr=False)
    omnibus: OmnibusTest
    omnibus_white: OmnibusTest
    p: float
    p_white: float
    column_penalty: float = ScreeningThresholds.column_penalty

    @property
    def count(self) -> int:
        """Different candidates that the parameters do not confound."""
        kept = {t.candidate.effect for t, df in zip(self.trials, self.plain.df, strict=True) if df}
        return max(1, len(kept))

    @property
    def explained(self) -> float:
        """Share of the residual that the best candidate carries."""
        return float(self.plain.explained.max(initial=0.0))

    def leaders(self, scores: ScoreTests, most: int, *, tables: bool = True) -> list[int]:
        """The best trial of each candidate, best candidate first."""
        rank = scores.statistics - self.column_penalty * np.maximum(scores.df - 1, 0)
        best: dict[str, int] = {}
        for i in np.argsort(-rank, kind="stable").tolist():
            trial = self.trials[i]
            if scores.df[i] and (tables or not trial.candidate.form.free):
                best.setdefault(trial.candidate.effect.name, i)
        return list(best.values())[:most]


def screen(workbench: LoopWorkbench, fitted: FittedModel, step: int) -> ScreeningResult:
    """Rank every candidate at a fit."""
    trajectories = workbench.trajectories(fitted)
    thresholds = workbench.thresholds.screening
    frequencies = _peaks(workbench.records, fitted.residuals, thresholds)
    candidates = make_candidates(
        fitted.problem, workbench.description, trajectories, frequencies, workbench.settings
    )
    if len(candidates) > workbench.size:
        raise DataError(
            f"closed loop: the training experiments must have at least as many measured values as "
            f"there are candidates, but have {workbench.size} for {len(candidates)}; add data, or "
            "name fewer in closed_loop.effects or closed_loop.sites"
        )
    trials = tuple(CandidatePoint(c, values) for c in candidates for values in c.grid)
    records, rows = thinned(workbench.records, thresholds.most_rows)
    columns = tuple(column[rows] for column in _columns(workbench, fitted, trajectories, trials))
    kept = _TestedRows(fitted.jacobian[rows], fitted.residuals[rows], columns)
    cleaned = kept.projection.remove(kept.residuals)
    coefficients = fit_autoregression(cleaned, records, thresholds.autoregression)
    white = kept.whitened(records, coefficients)
    streams = [workbench.generator(10 * step + stream) for stream in (2, 3, 4, 5)]
    draws = workbench.settings.draws
    plain_scores, white_scores = (
        score(each.projection, each.residuals, each.columns, thresholds.confounded)
        for each in (kept, white)
    )
    return ScreeningResult(
        trials=trials,
        columns=columns,
        rows=rows,
        plain=plain_scores,
        white=white_scores,
        omnibus=_smooth(kept, records, streams[0], thresholds),
        omnibus_white=_smooth(white, records, streams[3], thresholds),
        p=family_wise(plain_scores, streams[1], draws).p,
        p_white=family_wise(white_scores, streams[2], draws).p,
        column_penalty=thresholds.column_penalty,
    )


@dataclass(frozen=True)
class _TestedRows:
    """The rows that are tested: sensitivities, residuals and the candidates' columns."""

    matrix: FloatArray
    residuals: FloatArray
    columns: Sequence[FloatArray]

    @cached_property
    def projection(self) -> OrthogonalProjection:
        return OrthogonalProjection(self.matrix)

    def whitened(self, records: StackedRecords, coefficients: FloatArray) -> _TestedRows:
        """Whiten all of them by the same autoregression."""
        return _TestedRows(
            whiten(self.matrix, records, coefficients),
            whiten(self.residuals, records, coefficients),
            [whiten(column, records, coefficients) for column in self.columns],
        )


def _smooth(
    tested: _TestedRows,
    records: StackedRecords,
    generator: np.random.Generator,
    thresholds: ScreeningThresholds,
) -> OmnibusTest:
    """The omnibus test of a residual."""
    return omnibus(
        tested.projection,
        tested.residuals,
        records,
        generator,
        thresholds.omnibus_draws,
        thresholds.omnibus_lengths,
    )


def findings(
    screening: ScreeningResult, fitted: FittedModel, step: int
) -> dict[str, CandidateEvidence]:
    """The best trial of each candidate as a finding, by the effect's name."""
    found: dict[str, CandidateEvidence] = {}
    scores = screening.plain
    matrix = fitted.jacobian[screening.rows]
    for i in np.argsort(-scores.statistics, kind="stable").tolist():
        candidate = screening.trials[i].candidate
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
            confounded_with=_confounding_parameter(matrix, screening.columns[i], fitted)
            if aside
            else "",
        )
    return found


def _columns(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
) -> list[FloatArray]:
    """Directions of all trials: from the linear systems, or where there are none by simulation."""
    known = fitted.space.physical(fitted.x)
    targets = [p.target for p in fitted.problem.parameters]
    values = []
    for trajectory, row in zip(trajectories, known, strict=True):
        names = trajectory.linear.parameter_names if trajectory.linear is not None else ()
        values.append(np.array([row[targets.index(name)] for name in names], float))
    if workbench.exchange:
        return directions(trajectories, trials, values)
    outside = [t for t in trials if t.candidate.site.kind == "output"]
    inside = [t for t in trials if t.candidate.site.kind != "output"]
    found = dict(zip(map(id, outside), directions(trajectories, outside, values), strict=True))
    found |= dict(zip(map(id, inside), probe(workbench, fitted, trajectories, inside), strict=True))
    return [found[id(trial)] for trial in trials]


def _peaks(
    records: StackedRecords, residuals: FloatArray, thresholds: ScreeningThresholds
) -> list[float]:
    """Angular frequencies at which the residual of some record is strongest."""
    best: list[tuple[float, float]] = []
    for record in records.items:
        part, times = residuals[record.rows], record.times
        if len(part) < thresholds.peak_samples:
            continue
        step = float(np.median(np.diff(times)))
        power = np.abs(np.fft.rfft(part - part.mean())) ** 2 / len(part)
        rates = 2.0 * np.pi * np.fft.rfftfreq(len(part), step)
        order = np.argsort(-power[2:])[: thresholds.peaks] + 2
        best += [(float(power[k]), float(rates[k])) for k in order]
    found: list[float] = []
    for _, rate in sorted(best, reverse=True):
        if all(abs(rate - other) > thresholds.peak_distance * other for other in found):
            found.append(rate)
    return found[: thresholds.peaks]


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
