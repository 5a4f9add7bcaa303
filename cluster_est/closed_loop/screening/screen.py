"""Screening: compares every candidate with the residual to first order, and tests the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Self

import numpy as np

from cluster_est.closed_loop.candidates.arguments import (
    CandidatePlace,
    KinematicDefinition,
    count_candidates,
    open_arguments,
    open_places,
    variables_of,
)
from cluster_est.closed_loop.candidates.make import (
    EffectCandidate,
    OpenSites,
    finer_form,
    in_finer_form,
    make_candidates,
)
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import CandidatePoint, directions, probe
from cluster_est.closed_loop.screening.places import (
    COLUMN_PENALTY,
    LEADING_PLACES,
    PlaceThresholds,
    rank_places,
)
from cluster_est.closed_loop.settings import CandidateStage, LoopPart, LoopSettings, LoopStage
from cluster_est.statistics.projection import OrthogonalProjection, ProjectedResidual
from cluster_est.statistics.records import StackedRecords, thinned
from cluster_est.statistics.residual_tests import structure
from cluster_est.statistics.score import CONFOUNDED, ScoreTests, family_wise, score
from cluster_est.statistics.whiteness import SmoothnessTest
from cluster_est.statistics.whitening import fit_autoregression, whiten
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class ScreeningThresholds:
    """Thresholds of the score tests of all candidates.

    Attributes
    ----------
    most_rows
        Number of residuals that are screened; longer records are thinned. Memory: the directions
        of some hundred candidates are stored at once.
    most_values
        Number of screened residuals times the columns of all candidates. Memory: 128 MB, in some
        five copies.
    autoregression
        Order of the autoregression that whitens the residual. Benchmark.
    """

    most_rows: int = 20_000
    most_values: int = 16_000_000
    autoregression: int = 2


SCREENING = ScreeningThresholds()

SHORTEST_SPECTRUM = 16
"""Number of samples that a record needs for a spectrum. Signal."""
PEAKS, PEAK_DISTANCE = 2, 0.1
"""Number of peaks of the residual's spectrum at which periodic effects start, and the relative
distance from which two peaks count as different."""
LATER_PLACES = 10
"""Number of leading places at which forms are tried that differ little from other forms."""
CURVE_PLACES = 12
"""Number of leading free curves at whose places finer curves are tried."""
PROBED_PLACES = 4
"""Replaces both numbers if each candidate must be simulated, as in co-simulation."""


@dataclass(frozen=True)
class ScreeningResult:
    """All candidates, compared with the residual of a fit, and the tests of the best.

    Attributes
    ----------
    structure, structure_white
        Tests for any smooth structure, before and after whitening.
    p, p_white
        Family-wise p-values. If not all candidates were compared, they are multiplied by
        `CandidateRanking.unseen` (Bonferroni's inequality).
    """

    ranking: CandidateRanking = field(repr=False)
    structure: SmoothnessTest
    structure_white: SmoothnessTest
    p: float
    p_white: float

    @property
    def count(self) -> int:
        """Number of different candidates that the parameters do not confound."""
        return self.ranking.count

    def without_bases(self) -> Self:
        """Return the result without the arrays for pairs of candidates, which take some 100 MB."""
        return replace(self, ranking=self.ranking.without_bases())

    def without_directions(self) -> Self:
        """Return the part of the result that is reported after its round."""
        return replace(self, ranking=replace(self.ranking.without_bases(), columns=()))


def screen(
    fitter: Fitter, settings: LoopSettings, fitted: FittedModel, step: int
) -> ScreeningResult:
    """Rank every candidate at a fit, and test the best; each round uses its own random numbers."""
    ranking = rank(fitter, settings, fitted)
    streams = [fitter.generator(10 * step + stream) for stream in (3, 4)]
    draws = settings.draws

    def best(scores: ScoreTests, generator: np.random.Generator) -> float:
        first = scores.first(ranking.first)
        return min(ranking.unseen * family_wise(first, generator, draws), 1.0)

    tests: list[Callable[[], Any]] = [
        lambda: structure(ranking.residual, ranking.records),
        lambda: structure(ranking.residual_white, ranking.records),
        lambda: best(ranking.plain, streams[0]),
        lambda: best(ranking.white, streams[1]),
    ]
    found = []
    for done, test in enumerate(tests):
        fitter.runner.display.step(LoopStage.TESTS.value, done, len(tests))
        found.append(test())
    ranking = replace(ranking, white=ranking.white.without_bases())  # only the tests need them
    return ScreeningResult(ranking, *found)


@dataclass(frozen=True)
class CandidateEvidence:
    """One candidate and its evidence: a row of findings.parquet.

    Attributes
    ----------
    step
        Number of the round: 1 for the search for the first effect.
    site, form, family, variables
        Of the effect: "der(v)", "coulomb", "friction", ("v",).
    statistic, freedom
        Score statistic and its degrees of freedom.
    log_p
        Natural logarithm of its own p-value, not corrected for the number of candidates.
    explained
        Share of the residual sum of squares that its direction explains.
    distinct
        Norm of its direction outside the declared parameters, divided by the norm of the whole.
    stage
        The last stage that the candidate reached.
    criterion
        Bayesian information criterion of its refit, minus that of the model without the candidate;
        NaN if the candidate was not refitted.
    confounded_with
        For a candidate that was set aside: the declared parameter with the most similar direction.
    """

    step: int
    site: str
    form: str
    family: str
    variables: tuple[str, ...]
    statistic: float
    freedom: int
    log_p: float
    explained: float
    distinct: float
    stage: CandidateStage
    criterion: float = np.nan
    confounded_with: str = ""


def findings(
    ranking: CandidateRanking, fitted: FittedModel, step: int
) -> dict[str, CandidateEvidence]:
    """Return the evidence of each candidate, at its best trial, by the effect's name."""
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
    """The declared parameter whose sensitivity is most similar to a direction."""
    direction = column[:, 0]
    norms = np.linalg.norm(matrix, axis=0) * np.linalg.norm(direction)
    if not norms.size or not norms.max() > 0.0:
        return ""
    cosines = np.abs(direction @ matrix) / np.where(norms > 0.0, norms, np.inf)
    return fitted.space.unknowns[int(np.argmax(cosines))].label


PLACES_STREAM = 7
"""Random stream for the ranking of places; see `Fitter.generator`."""


@dataclass(frozen=True)
class CandidateRanking:
    """All candidates, compared with the residual of a fit.

    Attributes
    ----------
    trials
        Candidates at the points of their grids, one trial per point.
    columns
        The direction of each trial, (kept residuals, width).
    rows, records
        Indices of the residuals that were kept, and their records.
    plain, white
        Score tests against the residual, and against it after whitening by an autoregression.
    residual, residual_white
        The residuals of the two score tests.
    unseen
        Number of candidates that were considered, at least by their places, divided by the number
        of candidates that were compared with the residual.
    first
        Number of trials whose selection does not depend on the residual. The trials after them
        have later forms, at the leading places. Family-wise tests use only the first trials.
    sites, definitions
        The sites that were searched, and the equations of states that count as definitions.
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
    first: int = 0
    sites: tuple[str, ...] = ()
    definitions: tuple[KinematicDefinition, ...] = ()

    @property
    def count(self) -> int:
        """Number of candidates that the parameters do not confound, including unseen ones."""
        kept = {t.candidate.effect for t, df in zip(self.trials, self.plain.df, strict=True) if df}
        return max(1, round(len(kept) * self.unseen))

    def without_bases(self) -> Self:
        """Return the ranking without the bases of its scores."""
        return replace(self, plain=self.plain.without_bases(), white=self.white.without_bases())

    def leaders(self, scores: ScoreTests, most: int, *, free: bool = False) -> list[int]:
        """The best trial of each named candidate, or of each free one; the best comes first."""
        rank = scores.statistics - COLUMN_PENALTY * np.maximum(scores.df - 1, 0)
        best: dict[str, int] = {}
        for i in np.argsort(-rank, kind="stable").tolist():
            trial = self.trials[i]
            if scores.df[i] and trial.candidate.form.free is free:
                best.setdefault(trial.candidate.effect.name, i)
        return list(best.values())[:most]


def rank(
    fitter: Fitter,
    settings: LoopSettings,
    fitted: FittedModel,
    chosen: PlaceThresholds = LEADING_PLACES,
) -> CandidateRanking:
    """Rank every candidate at a fit.

    Each candidate is compared with the residual separately, so there may be more candidates than
    measured values. The criterion of the selection has the penalty for a choice among many.
    """
    trajectories = fitter.trajectories(fitted)
    opened = OpenSites(fitted.problem, fitter.description, trajectories, settings)
    candidates, possible = _candidates(fitter, opened, fitted, chosen)
    trials = points_of(candidates)
    width = sum(trial.width for trial in trials)
    most = min(SCREENING.most_rows, SCREENING.most_values // max(width, 1))
    records, rows = thinned(fitter.records, most)
    columns = candidate_columns(fitter, fitted, trajectories, trials, rows)
    matrix, residuals = fitted.jacobian[rows], fitted.residuals[rows]
    plain = ProjectedResidual(OrthogonalProjection(matrix), residuals)
    cleaned = plain.projection.remove(residuals)
    order = SCREENING.autoregression
    coefficients = fit_autoregression(cleaned, records, order, about_mean=True)

    def whitened(values: FloatArray) -> FloatArray:
        return whiten(values, records, coefficients)

    white = ProjectedResidual(OrthogonalProjection(whitened(matrix)), whitened(residuals))

    def scored(columns: Sequence[FloatArray]) -> tuple[ScoreTests, ScoreTests]:
        return (
            score(plain.projection, plain.residuals, columns, CONFOUNDED),
            score(white.projection, white.residuals, columns, CONFOUNDED, whitened),
        )

    found = CandidateRanking(
        trials,
        tuple(columns),
        rows,
        records,
        *scored(columns),
        residual=plain,
        residual_white=white,
        unseen=max(possible / max(len(candidates), 1), 1.0),
        first=len(trials),
        sites=opened.searched,
        definitions=opened.definitions,
    )
    further = points_of(_beside(fitter, settings, fitted, trajectories, found))
    if not further:
        return found
    new = candidate_columns(fitter, fitted, trajectories, further, rows)
    more_plain, more_white = scored(new)
    return replace(
        found,
        trials=(*trials, *further),
        columns=(*columns, *new),
        plain=found.plain.with_more(more_plain),
        white=found.white.with_more(more_white),
    )


def points_of(candidates: Sequence[EffectCandidate]) -> tuple[CandidatePoint, ...]:
    """Return the grid points of candidates as trials."""
    return tuple(CandidatePoint(c, values) for c in candidates for values in c.grid)


def _beside(
    fitter: Fitter,
    settings: LoopSettings,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    seen: CandidateRanking,
) -> list[EffectCandidate]:
    """The candidates with forms that are tried later, at the leading places."""
    scores = seen.plain
    rank = scores.statistics - COLUMN_PENALTY * np.maximum(scores.df - 1, 0)
    most = LATER_PLACES if fitter.by_linear_systems else PROBED_PLACES
    places: dict[CandidatePlace, None] = {}
    for i in np.argsort(-rank, kind="stable").tolist():
        candidate = seen.trials[i].candidate
        if len(places) < most and scores.df[i]:
            names = candidate.effect.variables
            places |= dict.fromkeys(CandidatePlace(candidate.site, name) for name in names)
    known = {trial.candidate.effect: trial.candidate for trial in seen.trials}
    given = (fitted.problem, fitter.description, trajectories, ())
    beside = list(known.values())
    return make_candidates(*given, settings, places, beside=beside) if places else []


def _candidates(
    fitter: Fitter, opened: OpenSites, fitted: FittedModel, chosen: PlaceThresholds
) -> tuple[list[EffectCandidate], int]:
    """All candidates, or those at leading places if there are many; the number considered."""
    frequencies = _peaks(fitter.records, fitted.residuals)
    settings, trajectories = opened.settings, opened.trajectories
    given = (fitted.problem, fitter.description, trajectories)
    arguments, sites = open_arguments(*given), opened.all
    forms = {site: opened.forms_at(site) for site in sites}
    everywhere = LoopPart.PLACES_FIRST in settings.without or not fitter.by_linear_systems
    most = chosen.most_candidates
    possible = (v for site in sites for f in forms[site] for v in variables_of(f, site, arguments))
    if everywhere or len(list(islice(possible, most + 1))) <= most:
        candidates = make_candidates(*given, frequencies, settings)
        if everywhere or len(candidates) <= fitter.size:
            return candidates, len(candidates)
    places = open_places(sites, arguments, trajectories)
    residual = ProjectedResidual(OrthogonalProjection(fitted.jacobian), fitted.residuals)
    generator = fitter.generator(PLACES_STREAM)
    ranked = rank_places(places, trajectories, residual, frequencies, generator)
    candidates = make_candidates(*given, frequencies, settings, ranked[: chosen.leading])
    looked_at = count_candidates(places, forms, arguments)
    return candidates, looked_at + sum(candidate.form.variables > 1 for candidate in candidates)


def candidate_columns(
    fitter: Fitter,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
    rows: IntArray | None = None,
) -> list[FloatArray]:
    """Compute the directions of all trials: from linear systems, or else by simulation.

    `rows` are the indices of the residuals that are kept; None for all.
    """
    known = fitted.space.physical(fitted.x)
    targets = [p.target for p in fitted.problem.parameters]
    values = []
    for trajectory, row in zip(trajectories, known, strict=True):
        names = trajectory.linear.parameter_names if trajectory.linear is not None else ()
        values.append(np.array([row[targets.index(name)] for name in names], float))
    if fitter.by_linear_systems:
        return directions(trajectories, trials, values, rows, fitter.compared)
    outside = [t for t in trials if t.candidate.site.kind == "output"]
    inside = [t for t in trials if t.candidate.site.kind != "output"]
    kept = slice(None) if rows is None else rows
    shown = iter(directions(trajectories, outside, values, rows))
    probed = iter(probe(fitter, fitted, trajectories, inside))
    return [
        next(shown) if t.candidate.site.kind == "output" else next(probed)[kept] for t in trials
    ]


def _peaks(records: StackedRecords, residuals: FloatArray) -> list[float]:
    """Angular frequencies of the highest peaks in the residual's spectra."""
    best: list[tuple[float, float]] = []
    for record in records.items:
        part, times = residuals[record.rows], record.times
        if len(part) < SHORTEST_SPECTRUM:
            continue
        step = float(np.median(np.diff(times)))
        power = np.abs(np.fft.rfft(part - part.mean())) ** 2 / len(part)
        rates = 2.0 * np.pi * np.fft.rfftfreq(len(part), step)
        order = np.argsort(-power[2:])[:PEAKS] + 2
        best += [(float(power[k]), float(rates[k])) for k in order]
    found: list[float] = []
    for _, rate in sorted(best, reverse=True):
        if all(abs(rate - other) > PEAK_DISTANCE * other for other in found):
            found.append(rate)
    return found[:PEAKS]


def rank_curves(
    fitter: Fitter,
    fitted: FittedModel,
    ranking: CandidateRanking,
    *,
    variables: int = 1,
) -> CandidateRanking:
    """Rank the leading free curves at a fit, together with finer curves at the same places.

    A coarse curve explains little of an effect that varies faster than the distance between its
    values, and the effect may seem stronger elsewhere. The ranking has only the curves, coarse
    ones first.

    Parameters
    ----------
    variables
        1 for curves of one argument, 2 for curves of a switch. Curves of a switch follow most of
        what the switch alone does, and would displace curves with fewer values.
    """
    leaders = [
        i
        for i in ranking.leaders(ranking.plain, len(ranking.trials), free=True)
        if max(ranking.trials[i].candidate.form.variables, 1) == variables
        and not ranking.trials[i].candidate.form.is_dynamics
    ][:CURVE_PLACES]
    coarse = [ranking.trials[i] for i in leaders]
    refined = len(coarse) if fitter.by_linear_systems else PROBED_PLACES
    finer = [
        CandidatePoint(candidate, values)
        for trial in coarse[:refined]
        for candidate in _finer_curves(trial.candidate)
        for values in candidate.grid
    ]
    new = candidate_columns(fitter, fitted, fitter.trajectories(fitted), finer, ranking.rows)
    columns = (*(ranking.columns[i] for i in leaders), *new)
    residual = ranking.residual
    scores = score(residual.projection, residual.residuals, columns, CONFOUNDED)
    return replace(ranking, trials=(*coarse, *finer), columns=columns, plain=scores)


def rank_filters(
    fitter: Fitter, settings: LoopSettings, fitted: FittedModel, ranking: CandidateRanking
) -> CandidateRanking:
    """Return the ranking with free filters added at the end, at the places that were tried.

    If the user has named the forms to try, none are added, as named filters are already tried.
    """
    if settings.forms:
        return ranking
    seen = [trial.candidate for trial in ranking.trials]
    places = {CandidatePlace(c.site, name) for c in seen for name in c.effect.variables}
    names = {form.name for form in FORMS.values() if form.is_dynamics and not form.finer_than}
    trajectories = fitter.trajectories(fitted)
    found = make_candidates(
        fitted.problem,
        fitter.description,
        trajectories,
        (),
        settings.changed(effects=tuple(names)),
        places if ranking.unseen > 1.0 else None,
    )
    trials = points_of(found)
    columns = candidate_columns(fitter, fitted, trajectories, trials, ranking.rows)
    scores = score(ranking.residual.projection, ranking.residual.residuals, columns, CONFOUNDED)
    return replace(
        ranking,
        trials=(*ranking.trials, *trials),
        columns=(*ranking.columns, *columns),
        plain=ranking.plain.with_more(scores),
    )


def leading_places(curves: CandidateRanking) -> list[int]:
    """Return the coarsest curve of each place, sorted by what the best curve there explains."""
    coarsest: dict[tuple[EffectSite, tuple[str, ...]], int] = {}
    for i, trial in enumerate(curves.trials):
        coarsest.setdefault(place_of(trial.candidate), i)
    leaders = curves.leaders(curves.plain, len(curves.trials), free=True)
    places = dict.fromkeys(place_of(curves.trials[i].candidate) for i in leaders)
    return [coarsest[place] for place in places]


def place_of(candidate: EffectCandidate) -> tuple[EffectSite, tuple[str, ...]]:
    """Return the site of a candidate, and its variables."""
    return candidate.site, candidate.effect.variables


def _finer_curves(coarse: EffectCandidate) -> list[EffectCandidate]:
    """Return the finer curves at the same place over the same range."""
    found, last = [], coarse
    while (form := finer_form(last)) is not None:
        last = in_finer_form(last, form)
        found.append(last)
    return found
