"""Neighbours of a refitted candidate: other functions of its argument.

The screening sees a small step from a model that lacks the effect. Where the effect is large the
motion with it is another one, on which two functions differ that looked alike before, and the
shortlist may have held the wrong one. So once a candidate has been refitted, the other functions of
its argument (sibling forms) are compared with it along the trajectory that it has led to, by linear
algebra, and those that could do the same are refitted from there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate, denser_grid
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.screen import CandidateRanking, candidate_columns
from cluster_est.closed_loop.selection.acceptance import can_be_linearised
from cluster_est.closed_loop.selection.linear_model import (
    REFINEMENT,
    is_proportional,
    values_at,
)
from cluster_est.closed_loop.selection.refits import (
    SHORT,
    RefittedCandidate,
    best_first,
    refit_fully,
)
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.statistics.projection import OrthogonalProjection
from workers.messages import FloatArray


def refit_siblings(
    fitter: Fitter,
    begun: RoundStart,
    current: FittedModel,
    ranking: CandidateRanking,
    contenders: Sequence[RefittedCandidate],
) -> list[RefittedCandidate]:
    """Refit other functions of the argument of the best contender, from where that one stands.

    In co-simulation, where nothing is known along the way, nothing is compared.

    Parameters
    ----------
    current, ranking
        The model that candidates are added to, and all candidates at it.
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
    """Return whether it is a function of the same argument; without one, at the same site."""
    own = best.candidate
    if candidate.form.free or candidate.effect.name in done:
        return False
    same = candidate.effect.variables == own.effect.variables
    return same and bool(own.effect.variables or candidate.site == own.site)


def starts_in_its_place(
    fitter: Fitter,
    current: FittedModel,
    best: RefittedCandidate,
    trials: Sequence[CandidatePoint],
    most: int,
) -> list[FitStart]:
    """Return the best candidate's model with the likeliest others in its place, at most some.

    Along its trajectory, what they should do is what it does and what it leaves; those that could
    not do as much are left out. `current` is the model that it was added to.
    """
    fitted = best.fitted
    name, values = best.candidate.effect.name, fitted.coefficients(best.candidate)
    own = CandidatePoint(best.candidate, best.candidate.point(values))
    columns = candidate_columns(fitter, fitted, _before(fitter, current, best), [own, *trials])
    strengths = best.candidate.sizes(values)
    target = columns[0] @ np.array(strengths or [1.0]) - fitted.residuals
    labels = [unknown.label for unknown in fitted.space.unknowns]
    others = [i for i, label in enumerate(labels) if not label.startswith(f"{name}.")]
    projection = OrthogonalProjection(fitted.jacobian[:, others])
    target = projection.remove(target)
    without = fitted.start.minus(len(fitted.added) - 1)
    found: dict[str, tuple[float, FitStart]] = {}
    for trial, column in zip(trials, columns[1:], strict=True):
        share, sizes = explained_share(
            target, projection.remove(column), free=is_proportional(trial)
        )
        rival = trial.candidate
        if share > found.get(rival.effect.name, (REFINEMENT.explains,))[0]:
            start = without.plus(rival, values_at(trial, sizes))
            found[rival.effect.name] = share, start
    ranked = sorted(found.values(), key=lambda each: -each[0])
    return [start for _, start in ranked[:most]]


def explained_share(
    target: FloatArray, columns: FloatArray, *, free: bool
) -> tuple[float, FloatArray]:
    """Return the share of a target's squares that columns explain, and the strength of each.

    If not `free` to be scaled, they count as they are and have no strengths.
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
    """Trajectories with the best candidate; an input at which it acts is as it was before it."""
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
