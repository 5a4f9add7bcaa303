"""Ranking of free curves: at each place that leads, with as many values as pay there."""

from __future__ import annotations

from dataclasses import replace

from cluster_est.closed_loop.candidates.finer_curves import finer_form, in_finer_form
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.ranking import CandidateRanking, candidate_columns
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.score import score
from workers.effects.site import EffectSite


def rank_curves(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    ranking: CandidateRanking,
    *,
    variables: int = 1,
) -> CandidateRanking:
    """Rank the leading free curves at a fit against finer ones at the same places.

    What changes faster than the values of a curve lie apart looks like little to that curve, and
    may look like more elsewhere.

    Parameters
    ----------
    fitted
        The model that a curve is added to.
    ranking
        Of all candidates at that model.
    variables
        1 for curves of one argument, 2 for those of a switch, which follow most of what the switch
        alone does and would crowd out curves that say less.

    Returns
    -------
    CandidateRanking
        Of these curves alone, against the residual as it is; the coarse ones come first.
    """
    thresholds = workbench.thresholds.screening
    leaders = [
        i
        for i in ranking.leaders(ranking.plain, len(ranking.trials), free=True)
        if max(ranking.trials[i].candidate.form.variables, 1) == variables
    ][: thresholds.curves]
    coarse = [ranking.trials[i] for i in leaders]
    refined = len(coarse) if workbench.by_linear_systems else thresholds.probed_curves
    finer = [
        CandidatePoint(candidate, values)
        for trial in coarse[:refined]
        for candidate in _finer(trial.candidate)
        for values in candidate.grid
    ]
    new = candidate_columns(workbench, fitted, workbench.trajectories(fitted), finer, ranking.rows)
    columns = (*(ranking.columns[i] for i in leaders), *new)
    residual = ranking.residual
    scores = score(residual.projection, residual.residuals, columns, thresholds.confounded)
    return replace(ranking, trials=(*coarse, *finer), columns=columns, plain=scores)


def leading_places(curves: CandidateRanking) -> list[int]:
    """Return the coarsest curve of each place, in the order of what the best one there explains."""
    coarsest: dict[tuple[EffectSite, tuple[str, ...]], int] = {}
    for i, trial in enumerate(curves.trials):
        coarsest.setdefault(place_of(trial.candidate), i)
    leaders = curves.leaders(curves.plain, len(curves.trials), free=True)
    places = dict.fromkeys(place_of(curves.trials[i].candidate) for i in leaders)
    return [coarsest[place] for place in places]


def place_of(candidate: EffectCandidate) -> tuple[EffectSite, tuple[str, ...]]:
    """Return where a candidate acts, and what it is a function of."""
    return candidate.site, candidate.effect.variables


def _finer(coarse: EffectCandidate) -> list[EffectCandidate]:
    """Return the finer curves at the same place over the same range."""
    found, last = [], coarse
    while (form := finer_form(last)) is not None:
        last = in_finer_form(last, form)
        found.append(last)
    return found
