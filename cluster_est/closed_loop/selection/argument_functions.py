"""Other functions of an argument: forms of the library, and free curves.

A score describes a small step from a model without the effect. If the effect is large, the
trajectory changes. Two functions that looked alike on the old trajectory may then differ, and the
shortlist may have contained the wrong one. So after a candidate has been refitted, the other
functions of its argument (sibling forms) are compared with it by linear algebra, along its new
trajectory. Those that could explain as much are refitted from there. So is the same form with other
arguments, because arguments that were alike on the old trajectory may differ on the new one.

A free curve is not a form of the library: it is a table of places and values. It fits what several
named effects would only imitate, but it does not explain anything. So it is tried where no named
effect is accepted. At the end of a search it is also tried in place of all accepted effects, if
they leave more than noise. A search ends with a curve that closes most of the gap, because its
remaining error is partly its own. A curve can also lead to a named effect, through the siblings of
the best curve. Free filters are the same for dynamics: a step response without a name.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import (
    EffectCandidate,
    denser_grid,
    finer_form,
    refined,
)
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.screen import (
    SCREENING,
    CandidateRanking,
    candidate_columns,
    leading_places,
    place_of,
    rank_curves,
    rank_filters,
)
from cluster_est.closed_loop.selection.acceptance import can_be_linearised
from cluster_est.closed_loop.selection.gates import SELECTION, choose
from cluster_est.closed_loop.selection.linear_model import (
    NO_BOUND,
    REFINEMENT,
    PruningBound,
    can_reach,
    first_steps,
    gauss_newton_step,
    is_proportional,
    longest_step,
    values_at,
)
from cluster_est.closed_loop.selection.refits import (
    SHORT,
    RefittedCandidate,
    best_first,
    refit_fully,
)
from cluster_est.closed_loop.selection.rounds import (
    AcceptedStructure,
    RoundEnd,
    RoundStart,
    can_be_claimed,
    claimable_sse,
    may_leave_noise,
)
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression
from workers.messages import FloatArray


def free_curve(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose free curves, and the forms of the library to which the best curve leads.

    Curves of a switch are included, because no named effect passes in this round.
    """
    del best
    coarse = [*coarse_curves(fitter, begun), *switched_curves(fitter, begun)]
    coarse = sorted(coarse, key=lambda c: c.criterion)
    found = [*coarse, *finer_curves(fitter, begun, coarse)]
    curves = sorted(found, key=lambda c: c.criterion)
    return [*curves, *refit_named(fitter, begun, curves)]


def coarse_curves(fitter: Fitter, begun: RoundStart) -> list[RefittedCandidate]:
    """Refit curves with few values to convergence; the best comes first.

    The curves at the leading places are refitted first. If the best of them is nearly right, those
    at other places that could explain as much follow.
    """
    most = REFINEMENT.curves if begun.has(LoopPart.FREE_CURVE) else 0
    curves = rank_curves(fitter, begun.model, begun.screening.ranking)
    places = leading_places(curves)
    seen = _refitted(fitter, begun, curves, places[:most])
    others = [curves.trials[i] for i in places]
    seen += refit_fully(fitter, _in_other_places(fitter, begun, others, seen))
    return best_first(fitter.records, seen)


def switched_curves(fitter: Fitter, begun: RoundStart) -> list[RefittedCandidate]:
    """Refit the leading curve of a switch, such as friction whose level depends on the position.

    It is used only if no named effect passes, or if no found effect may be claimed: it contains
    what a switch alone does, and also follows other effects.
    """
    if not (begun.has(LoopPart.FREE_CURVE) and begun.has(LoopPart.SWITCHED_CURVES)):
        return []
    curves = rank_curves(fitter, begun.model, begun.screening.ranking, variables=2)
    seen = _refitted(fitter, begun, curves, leading_places(curves)[:1])
    return best_first(fitter.records, seen)


def with_filters(fitter: Fitter, begun: RoundStart) -> RoundStart:
    """Return the start of a round with free filters added to the ranking."""
    if not begun.has(LoopPart.FREE_DYNAMICS):
        return begun
    ranking = rank_filters(fitter, begun.settings, begun.model, begun.screening.ranking)
    return replace(begun, screening=replace(begun.screening, ranking=ranking))


def free_dynamics(fitter: Fitter, begun: RoundStart, best: RoundEnd) -> list[RefittedCandidate]:
    """Propose free filters, and the forms of the library to which the best filter leads."""
    del best
    filters = refit_filters(fitter, begun)
    return [*filters, *refit_named(fitter, begun, filters)]


def refit_filters(
    fitter: Fitter, begun: RoundStart, bound: PruningBound = NO_BOUND
) -> list[RefittedCandidate]:
    """Refit free filters at the leading places, from low to high order; the best comes first.

    Only filters that may reach a claim go on, so that a missing disturbance costs little.
    """
    if not begun.has(LoopPart.FREE_DYNAMICS):
        return []
    least = begun.bound(sse=claimable_sse(begun))
    ranking = begun.screening.ranking
    trials = [trial for trial in ranking.trials if trial.candidate.form.is_dynamics]
    leaders = [
        i
        for i in ranking.leaders(ranking.plain, len(ranking.trials), free=True)
        if ranking.trials[i].candidate.form.is_dynamics
    ]
    seen = _refitted(fitter, begun, ranking, leaders[: REFINEMENT.curves], least)
    seen += refit_fully(fitter, _in_other_places(fitter, begun, trials, seen))
    coarse = best_first(fitter.records, seen)
    found = [*coarse, *finer_curves(fitter, begun, coarse, bound)]
    return sorted(found, key=lambda c: c.criterion)


def _refitted(
    fitter: Fitter,
    begun: RoundStart,
    ranking: CandidateRanking,
    leaders: Sequence[int],
    bound: PruningBound = NO_BOUND,
) -> list[FittedModel]:
    """Refit trials of a ranking to convergence; those that cannot reach a bound are left out."""
    starts = [step.start for step in first_steps(fitter, begun.model, ranking, leaders, bound)]
    brief = [f for f in fitter.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    return refit_fully(fitter, brief)


def finer_curves(
    fitter: Fitter,
    begun: RoundStart,
    coarse: Sequence[RefittedCandidate],
    bound: PruningBound = NO_BOUND,
) -> list[RefittedCandidate]:
    """Refit finer curves, starting from refitted coarser ones; the best comes first.

    A fine curve has many values, and its first step is misleading if the effect is large. So at
    each place that leaves more than noise, the curve is refined in steps, each with twice as many
    values, starting from the previous fit. This goes on as long as the criterion falls and both a
    claim and the bound are in reach. Places that fall behind are not refined.
    """
    records, alternative = fitter.records, REFINEMENT.alternative
    prunes = begun.has(LoopPart.PRUNING)
    claim = claimable_sse(begun) if prunes else np.inf
    bound = replace(bound, sse=min(bound.sse, claim))
    going = [curve.fitted for curve in coarse]
    seen: list[FittedModel] = []
    while going:
        going = _finer_fits(fitter, begun, going, bound)
        seen += going
        best = min((f.criterion(records) for f in seen), default=np.inf)
        going = [f for f in going if f.criterion(records) <= best + alternative]
    return best_first(fitter.records, seen)


def _in_other_places(
    fitter: Fitter,
    begun: RoundStart,
    trials: Sequence[CandidatePoint],
    seen: Sequence[FittedModel],
) -> list[FittedModel]:
    """Refit curves or filters at other places briefly, starting from the best one.

    On a trajectory far from the data, many places look alike; on one that is nearly right, they
    differ.
    """
    if not seen or not begun.has(LoopPart.OTHER_PLACES):
        return []
    records = fitter.records
    best = min(seen, key=lambda f: f.criterion(records))
    closed = begun.model.sse - best.sse
    if closed < REFINEMENT.closes * (begun.model.sse - begun.floor) or not fitter.by_linear_systems:
        return []
    known = {place_of(f.added[-1]) for f in seen}
    trials = [trial for trial in trials if place_of(trial.candidate) not in known]
    if not trials or not can_be_linearised(fitter, best):
        return []
    own = RefittedCandidate(best, best.criterion(records), True)
    starts = starts_in_its_place(fitter, begun.model, own, trials, REFINEMENT.curves)
    return [f for f in fitter.fit(LoopStage.REFITS, starts, SHORT) if f is not None]


def refit_named(
    fitter: Fitter, begun: RoundStart, curves: Sequence[RefittedCandidate]
) -> list[RefittedCandidate]:
    """Refit forms of the library in place of the best curve, starting from its fit."""
    named = refit_siblings(fitter, begun, begun.model, begun.screening.ranking, curves[:1])
    return sorted(named, key=lambda c: c.criterion)


def _finer_fits(
    fitter: Fitter, begun: RoundStart, fits: Sequence[FittedModel], bound: PruningBound
) -> list[FittedModel]:
    """Refit each curve with twice as many values, if it leaves more than noise or is behind.

    Curves are left out if their criterion does not fall, or if they cannot reach the bound.
    """
    # two standard deviations above the sum of squares that noise alone leaves
    most = begun.floor * (1.0 + 2.0 * np.sqrt(2.0 / max(fitter.size, 1)))
    rough = [f for f in fits if f.sse > most or f.criterion(fitter.records) > bound.criterion]
    asked = [(f, start) for f in rough if (start := _finer_start(fitter, f)) is not None]
    brief = fitter.fit(LoopStage.REFITS, [start for _, start in asked], SHORT)
    hopeful = [
        (old, new)
        for (old, _), new in zip(asked, brief, strict=True)
        if new is not None and can_reach(fitter.records, new, _reachable(new, bound))
    ]
    finished = refit_fully(fitter, [new for _, new in hopeful])
    records = fitter.records
    return [
        new
        for (old, _), new in zip(hopeful, finished, strict=True)
        if new.criterion(records) < old.criterion(records)
    ]


def _reachable(fitted: FittedModel, bound: PruningBound) -> PruningBound:
    """The bound for a curve: only the finest curve must already reach the bound's criterion."""
    finest = finer_form(fitted.added[-1]) is None
    return bound if finest else PruningBound(sse=bound.sse)


def _finer_start(fitter: Fitter, fitted: FittedModel) -> FitStart | None:
    """The model with a finer curve of the same shape; None if there is no finer form."""
    curve = fitted.added[-1]
    form = finer_form(curve)
    if form is None or not can_be_linearised(fitter, fitted):
        return None
    trajectories = fitter.trajectories(fitted)
    finer, heights = refined(curve, fitted.coefficients(curve), trajectories, form)
    return fitted.start.minus(len(fitted.added) - 1).plus(finer, heights)


def curve_instead(fitter: Fitter, first: RoundStart, now: AcceptedStructure) -> RoundEnd | None:
    """Return a round in which one effect wins in place of all accepted ones; None if they stay.

    It is tried only if the accepted effects leave more than noise. The new effect is a free curve,
    a free filter, or a form of the library to which one leads. It must predict better and fit
    better, also under the assumption of coloured noise. A curve or a filter must also
    close enough of the gap for a claim, and improve the criterion by the penalty for a choice among
    all pairs: what follows a disturbance a little better is no reason to start again from there.

    Parameters
    ----------
    first
        The start of the first round of the search.
    now
        The structure at the end of the search, which no larger structure improves.
    """
    current, records = now.model, fitter.records
    free = any(candidate.form.free for candidate in current.added)
    left = not may_leave_noise(first, current)
    tried = first.has(LoopPart.FREE_CURVE) or first.has(LoopPart.FREE_DYNAMICS)
    if free or not left or not tried or not first.has(LoopPart.CURVE_INSTEAD):
        return None
    first = with_filters(fitter, first)
    coarse = coarse_curves(fitter, first)
    named = refit_named(fitter, first, coarse)
    coarse += switched_curves(fitter, first)
    bound = first.bound(criterion=current.criterion(records))
    finer = finer_curves(fitter, first, coarse, bound)
    filters = refit_filters(fitter, first, bound)
    named += refit_named(fitter, first, filters)
    curves = [c for c in (*coarse, *finer, *filters) if can_be_claimed(first, c.fitted)]
    curves.sort(key=lambda c: c.criterion)
    price = SELECTION.pair_price * float(np.log(first.screening.count))

    def fits_better(contender: RefittedCandidate, least: float) -> bool:
        return min(criterion_falls(records, current, contender.fitted)) > least

    for contenders, least in ((named, 0.0), (curves, price)):
        if not any(fits_better(contender, least) for contender in contenders):
            continue  # the gates cost simulations
        end = choose(fitter, first, contenders)
        if end.won is None or end.prediction is None or not fits_better(end.won, least):
            continue
        if end.prediction.total < now.prediction.total:
            return end
    return None


def coloured_criterion(fitted: FittedModel, records: StackedRecords, order: int) -> float:
    """The criterion under the assumption that each output's noise is an autoregression.

    For coloured residuals, the plain criterion counts correlated samples as independent evidence,
    so that many coefficients seem to pay for themselves.
    """
    coefficients = fit_autoregression(fitted.residuals, records, order)
    likelihood = deviance(fitted.residuals, records, coefficients)
    return float(likelihood + fitted.space.size * np.log(len(fitted.residuals)))


def criterion_falls(
    records: StackedRecords, before: FittedModel, after: FittedModel
) -> tuple[float, float]:
    """The fall of the criterion: for white noise, and for noise as coloured as the residual."""
    order = SCREENING.autoregression
    coloured = [coloured_criterion(fitted, records, order) for fitted in (before, after)]
    return before.criterion(records) - after.criterion(records), coloured[0] - coloured[1]


def refit_siblings(
    fitter: Fitter,
    begun: RoundStart,
    current: FittedModel,
    ranking: CandidateRanking,
    contenders: Sequence[RefittedCandidate],
) -> list[RefittedCandidate]:
    """Refit siblings of the best contender, starting from its fit.

    These are other functions of its argument, and its function of other arguments. In co-simulation
    there are none, because the signals inside the model are not known.

    Parameters
    ----------
    current, ranking
        The model to which candidates are added, and the ranking of all candidates at this model.
    contenders
        Refitted candidates, the best first. Those that converged are not refitted again.
    """
    if not begun.has(LoopPart.SIBLINGS) or not fitter.by_linear_systems:
        return []
    if not contenders or not contenders[0].full:
        return []
    best = contenders[0]
    done = {c.candidate.effect.name for c in contenders if c.full}
    named = {t.candidate.effect.name: t.candidate for t in ranking.trials}
    rivals = [candidate for candidate in named.values() if _is_rival(candidate, best, done)]
    if not rivals or not can_be_linearised(fitter, best.fitted):
        return []
    trajectories = fitter.trajectories(best.fitted)
    trials = [
        CandidatePoint(candidate, values)
        for candidate in rivals
        for values in denser_grid(candidate, trajectories)
    ]
    starts = starts_in_its_place(fitter, current, best, trials, REFINEMENT.finalists)
    fits = [f for f in fitter.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    brief = best_first(fitter.records, fits, LoopPart.SIBLINGS, full=False)
    most = best.criterion + REFINEMENT.alternative
    near = refit_fully(fitter, [c.fitted for c in brief if c.criterion < most])
    far = [c for c in brief if c.criterion >= most]
    return [*best_first(fitter.records, near, LoopPart.SIBLINGS), *far]


def _is_rival(candidate: EffectCandidate, best: RefittedCandidate, done: Collection[str]) -> bool:
    """Return whether a candidate has the argument of the best one, or its site and form.

    Without an argument, the site must be the same.
    """
    own = best.candidate
    if candidate.form.free or candidate.effect.name in done:
        return False
    here = candidate.site == own.site
    if here and candidate.form is own.form:
        return True
    same = candidate.effect.variables == own.effect.variables
    return same and bool(own.effect.variables or here)


def starts_in_its_place(
    fitter: Fitter,
    current: FittedModel,
    best: RefittedCandidate,
    trials: Sequence[CandidatePoint],
    most: int,
) -> list[FitStart]:
    """Return the best candidate's model with other candidates in its place, the most likely first.

    The target of the others is the change by the best candidate, plus what its fit leaves, along
    its trajectory. Candidates that could not explain enough of it are left out. The other unknowns
    move as the linear model proposes.

    Parameters
    ----------
    current
        The model without the best candidate. If the candidate acts at an input, this input is
        taken from this model.
    best
        The candidate is the last effect of its model. `ending_with` moves another one to the end.
    trials
        Candidates to try in its place.
    """
    fitted = best.fitted
    name, values = best.candidate.effect.name, fitted.coefficients(best.candidate)
    own = CandidatePoint(best.candidate, best.candidate.point(values))
    columns = candidate_columns(fitter, fitted, _before(fitter, current, best), [own, *trials])
    strengths = best.candidate.sizes(values)
    target = columns[0] @ np.array(strengths or [1.0]) - fitted.residuals
    labels = [unknown.label for unknown in fitted.space.unknowns]
    others = [i for i, label in enumerate(labels) if not label.startswith(f"{name}.")]
    matrix = fitted.jacobian[:, others]
    projection = OrthogonalProjection(matrix)
    all_of_it, target = target, projection.remove(target)
    without = fitted.start.minus(len(fitted.added) - 1)
    found: dict[str, tuple[float, FitStart]] = {}
    for trial, column in zip(trials, columns[1:], strict=True):
        share, sizes = explained_share(
            target, projection.remove(column), free=is_proportional(trial)
        )
        rival = trial.candidate
        if share > found.get(rival.effect.name, (REFINEMENT.explains,))[0]:
            acting = column @ sizes if len(sizes) else column[:, 0]
            step = np.zeros(len(labels))
            step[others] = gauss_newton_step(matrix, acting - all_of_it)
            moved = {**without.values, **_estimates_after(fitted, step)}
            start = replace(without, values=moved).plus(rival, values_at(trial, sizes))
            found[rival.effect.name] = share, start
    ranked = sorted(found.values(), key=lambda each: -each[0])
    return [start for _, start in ranked[:most]]


def _estimates_after(fitted: FittedModel, step: FloatArray) -> dict[str, float]:
    """Return the values after a step in search coordinates, shortened and kept within bounds."""
    space, most = fitted.space, longest_step(fitted.space, fitted.x, REFINEMENT.largest_step)
    moved = np.clip(fitted.x + np.clip(step, -most, most), space.lower, space.upper)
    return space.estimates(moved)


def explained_share(
    target: FloatArray, columns: FloatArray, *, free: bool
) -> tuple[float, FloatArray]:
    """Return the share of a target's squares that columns explain, and the strength of each.

    If not `free`, the columns are used without scaling and have no strengths.
    """
    lengths = np.linalg.norm(columns, axis=0)
    whole = float(np.add.reduce(target**2))
    if not whole > 0.0 or not (lengths > 0.0).all():
        return 0.0, np.zeros(columns.shape[1] if free else 0)
    if not free:
        return 1.0 - float(np.add.reduce((target - columns[:, 0]) ** 2)) / whole, np.zeros(0)
    sizes = np.linalg.lstsq(columns / lengths, target, rcond=1e-6)[0] / lengths
    return 1.0 - float(np.add.reduce((target - columns @ sizes) ** 2)) / whole, sizes


def _before(
    fitter: Fitter, current: FittedModel, best: RefittedCandidate
) -> list[LinearisedTrajectory]:
    """Trajectories with the best candidate; its own input has the values without the candidate."""
    trajectories = fitter.trajectories(best.fitted)
    site = best.candidate.site
    if site.kind != "input":
        return trajectories
    return [
        replace(
            new,
            signals={
                **new.signals,
                site.target: np.interp(new.times, old.times, old.signals[site.target]),
            },
        )
        for new, old in zip(trajectories, fitter.trajectories(current), strict=True)
    ]
