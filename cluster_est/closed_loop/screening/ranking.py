"""Ranking: the direction of every candidate against the residual, scored but not tested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from cluster_est.closed_loop.candidates.arguments import CandidatePlace, open_arguments
from cluster_est.closed_loop.candidates.make import EffectCandidate, make_candidates
from cluster_est.closed_loop.candidates.places import (
    count_candidates,
    count_variables,
    open_places,
)
from cluster_est.closed_loop.candidates.sites import candidate_sites, forms_at
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.screening.directions import CandidatePoint, directions
from cluster_est.closed_loop.screening.places import rank_places
from cluster_est.closed_loop.screening.probe import probe
from cluster_est.closed_loop.thresholds import ScreeningThresholds
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.projection import (
    OrthogonalProjection,
    ProjectedResidual,
)
from cluster_est.statistics.records import StackedRecords, thinned
from cluster_est.statistics.score import ScoreTests, score
from cluster_est.statistics.whitening import fit_autoregression, whiten
from workers.messages import FloatArray, IntArray

PLACES = 7
"""Stream of the random generator of the places; see `LoopWorkbench.generator`."""


@dataclass(frozen=True)
class CandidateRanking:
    """All candidates against the residual of a fit.

    Attributes
    ----------
    trials
        Candidates at the points of their grids.
    columns
        The direction of each trial, (kept residuals, width).
    rows
        Indices of the residuals that were kept.
    records
        Of these.
    plain, white
        Scores against the residual as it is, and after both were whitened by an autoregression.
    residual, residual_white
        What they were scored against.
    unseen
        Candidates that were looked at, if only by their places, for each that was compared itself.
    column_penalty
        See `ScreeningThresholds`.
    """

    trials: tuple[CandidatePoint, ...]
    columns: tuple[FloatArray, ...] = field(repr=False)
    rows: IntArray = field(repr=False)
    records: StackedRecords = field(repr=False)
    plain: ScoreTests = field(repr=False)
    white: ScoreTests = field(repr=False)
    residual: ProjectedResidual = field(repr=False)
    residual_white: ProjectedResidual = field(repr=False)
    unseen: float = 1.0
    column_penalty: float = ScreeningThresholds.column_penalty

    @property
    def count(self) -> int:
        """Different candidates that the parameters do not confound, the unseen ones among them."""
        kept = {t.candidate.effect for t, df in zip(self.trials, self.plain.df, strict=True) if df}
        return max(1, round(len(kept) * self.unseen))

    def without_bases(self) -> Self:
        """Return it without the bases of its scores."""
        return replace(self, plain=self.plain.without_bases(), white=self.white.without_bases())

    def leaders(self, scores: ScoreTests, most: int, *, free: bool = False) -> list[int]:
        """The best trial of each named candidate, or of each free curve; the best first."""
        rank = scores.statistics - self.column_penalty * np.maximum(scores.df - 1, 0)
        best: dict[str, int] = {}
        for i in np.argsort(-rank, kind="stable").tolist():
            trial = self.trials[i]
            if scores.df[i] and trial.candidate.form.free is free:
                best.setdefault(trial.candidate.effect.name, i)
        return list(best.values())[:most]


def rank(workbench: LoopWorkbench, fitted: FittedModel) -> CandidateRanking:
    """Rank every candidate at a fit.

    Each is compared with the residual by itself, so there may be more candidates than measured
    values: what the choice among many costs is in the criterion of the selection.
    """
    trajectories = workbench.trajectories(fitted)
    thresholds = workbench.thresholds.screening
    candidates, possible = _candidates(workbench, fitted, trajectories)
    trials = tuple(CandidatePoint(c, values) for c in candidates for values in c.grid)
    width = sum(trial.width for trial in trials)
    most = min(thresholds.most_rows, thresholds.most_values // max(width, 1))
    records, rows = thinned(workbench.records, most)
    columns = tuple(candidate_columns(workbench, fitted, trajectories, trials, rows))
    matrix, residuals = fitted.jacobian[rows], fitted.residuals[rows]
    plain = ProjectedResidual(OrthogonalProjection(matrix), residuals)
    cleaned = plain.projection.remove(residuals)
    order = thresholds.autoregression
    coefficients = fit_autoregression(cleaned, records, order, about_mean=True)

    def whitened(values: FloatArray) -> FloatArray:
        return whiten(values, records, coefficients)

    white = ProjectedResidual(OrthogonalProjection(whitened(matrix)), whitened(residuals))
    least = thresholds.confounded
    return CandidateRanking(
        trials=trials,
        columns=columns,
        rows=rows,
        records=records,
        plain=score(plain.projection, plain.residuals, columns, least),
        white=score(white.projection, white.residuals, columns, least, whitened),
        residual=plain,
        residual_white=white,
        unseen=max(possible / max(len(candidates), 1), 1.0),
        column_penalty=thresholds.column_penalty,
    )


def _candidates(
    workbench: LoopWorkbench, fitted: FittedModel, trajectories: Sequence[LinearisedTrajectory]
) -> tuple[list[EffectCandidate], int]:
    """All candidates, or those at leading places where there are many; how many were looked at."""
    description, settings = workbench.description, workbench.settings
    frequencies = _peaks(workbench.records, fitted.residuals, workbench.thresholds.screening)
    given = (fitted.problem, description, trajectories)
    sites = candidate_sites(*given, settings)
    arguments = open_arguments(*given)
    forms = {site: forms_at(site, fitted.problem, description, settings) for site in sites}
    possible = sum(count_variables(f, site, arguments) for site in sites for f in forms[site])
    if not workbench.by_linear_systems or possible <= workbench.thresholds.places.most_candidates:
        candidates = make_candidates(*given, frequencies, settings)
        if not workbench.by_linear_systems or len(candidates) <= workbench.size:
            return candidates, len(candidates)
    places = open_places(sites, arguments, trajectories)
    leading = _leading(workbench, fitted, trajectories, places, frequencies)
    candidates = make_candidates(*given, frequencies, settings, leading)
    looked_at = count_candidates(places, forms, arguments)
    return candidates, looked_at + sum(candidate.form.variables > 1 for candidate in candidates)


def _leading(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    places: Sequence[CandidatePlace],
    frequencies: Sequence[float],
) -> list[CandidatePlace]:
    """The places at which a free curve explains the most."""
    thresholds = workbench.thresholds.places
    residual = ProjectedResidual(OrthogonalProjection(fitted.jacobian), fitted.residuals)
    generator = workbench.generator(PLACES)
    ranked = rank_places(places, trajectories, residual, frequencies, generator, thresholds)
    return [each.place for each in ranked[: thresholds.leading]]


def candidate_columns(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
    rows: IntArray | None = None,
) -> list[FloatArray]:
    """Directions of all trials: from the linear systems, or where there are none by simulation.

    `rows` are the residuals that are kept; None for all of them.
    """
    known = fitted.space.physical(fitted.x)
    targets = [p.target for p in fitted.problem.parameters]
    values = []
    for trajectory, row in zip(trajectories, known, strict=True):
        names = trajectory.linear.parameter_names if trajectory.linear is not None else ()
        values.append(np.array([row[targets.index(name)] for name in names], float))
    if workbench.by_linear_systems:
        return directions(trajectories, trials, values, rows, workbench.compared)
    outside = [t for t in trials if t.candidate.site.kind == "output"]
    inside = [t for t in trials if t.candidate.site.kind != "output"]
    kept = slice(None) if rows is None else rows
    shown = directions(trajectories, outside, values, rows)
    found = dict(zip(map(id, outside), shown, strict=True))
    probed = (column[kept] for column in probe(workbench, fitted, trajectories, inside))
    found |= dict(zip(map(id, inside), probed, strict=True))
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
