"""Other functions of the same argument, compared where the best candidate has led.

The screening sees a small step from a model that lacks the effect. Where the effect is large the
motion with it is another one, on which two functions differ that looked alike before, and the
shortlist may have held the wrong one. So once a candidate has been refitted, the other functions of
its argument are compared with it along the trajectory that it has led to, by linear algebra, and
those that could do the same are refitted from there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.denser_grid import denser_grid
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.ranking import CandidateRanking, candidate_columns
from cluster_est.closed_loop.selection.accept import can_be_linearised
from cluster_est.closed_loop.selection.refinement.first_steps import is_proportional, values_at
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.refinement.refits import SHORT, full_refit
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.statistics.projection import OrthogonalProjection
from workers.messages import FloatArray


def refit_same_argument(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    contenders: Sequence[RefittedCandidate],
) -> list[RefittedCandidate]:
    """Refit other functions of the argument of the best contender, from where that one stands.

    In co-simulation, where nothing is known along the way, nothing is compared.

    Parameters
    ----------
    current
        The model that candidates are added to.
    ranking
        Of all candidates at that model.
    contenders
        Refitted candidates, the best first. Those that converged are not refitted again.

    Returns
    -------
    list of RefittedCandidate
        Those that were refitted, in no order.
    """
    if not contenders or not contenders[0].full or not workbench.by_linear_systems:
        return []
    best = contenders[0]
    done = {c.candidate.effect.name for c in contenders if c.full}
    named = {t.candidate.effect.name: t.candidate for t in ranking.trials}
    rivals = [candidate for candidate in named.values() if _is_rival(candidate, best, done)]
    if not rivals or not can_be_linearised(workbench, best.fitted):
        return []
    trajectories = workbench.trajectories(best.fitted)
    trials = [
        CandidatePoint(candidate, values)
        for candidate in rivals
        for values in denser_grid(candidate, trajectories)
    ]
    count = workbench.thresholds.refinement.same_argument
    starts = starts_in_its_place(workbench, current, best, trials, count)
    brief = [f for f in workbench.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    most = best.criterion + workbench.thresholds.refinement.alternative
    criteria = [fitted.criterion(workbench.records) for fitted in brief]
    near = [f for f, criterion in zip(brief, criteria, strict=True) if criterion < most]
    finished = workbench.fit(LoopStage.REFITS, [f.start for f in near], full_refit(workbench))
    full = [new or old for new, old in zip(finished, near, strict=True)]
    far = [
        RefittedCandidate(f, criterion, False)
        for f, criterion in zip(brief, criteria, strict=True)
        if criterion >= most
    ]
    return [RefittedCandidate(f, f.criterion(workbench.records), True) for f in full] + far


def _is_rival(candidate: EffectCandidate, best: RefittedCandidate, done: Collection[str]) -> bool:
    """Return whether it is a function of the same argument; without one, at the same site."""
    own = best.candidate
    if candidate.form.free or candidate.effect.name in done:
        return False
    same = candidate.effect.variables == own.effect.variables
    return same and bool(own.effect.variables or candidate.site == own.site)


def starts_in_its_place(
    workbench: LoopWorkbench,
    current: FittedModel,
    best: RefittedCandidate,
    trials: Sequence[CandidatePoint],
    most: int,
) -> list[FitStart]:
    """Return the best candidate's model with the likeliest others in its place.

    Along its trajectory, what they should do is what it does and what it leaves.

    Parameters
    ----------
    current
        The model that it was added to.
    best
        The candidate, refitted.
    trials
        The others, at points of their grids.
    most
        Number of different ones that are wanted; those that could not do as much are left out.
    """
    thresholds = workbench.thresholds.refinement
    fitted = best.fitted
    name = best.candidate.effect.name
    values = tuple(_value(fitted, c.name, best) for c in best.candidate.form.coefficients)
    own = CandidatePoint(best.candidate, values)
    columns = candidate_columns(
        workbench, fitted, _before(workbench, current, best), [own, *trials]
    )
    strengths = [v for c, v in zip(own.candidate.form.coefficients, values, strict=True)
                 if c.name in own.candidate.strengths]  # fmt: skip
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
        if share > found.get(rival.effect.name, (thresholds.explains,))[0]:
            start = without.plus(rival, values_at(trial, sizes, thresholds))
            found[rival.effect.name] = share, start
    ranked = sorted(found.values(), key=lambda each: -each[0])
    return [start for _, start in ranked[:most]]


def explained_share(
    target: FloatArray, columns: FloatArray, *, free: bool
) -> tuple[float, FloatArray]:
    """Return the share of a target's squares that columns explain, and the strength of each.

    Parameters
    ----------
    target : (n,)
    columns : (n, width)
    free
        They are scaled to fit; without, they count as they are and have no strengths.
    """
    lengths = np.linalg.norm(columns, axis=0)
    whole = float(np.add.reduce(target**2))
    if not whole > 0.0 or not (lengths > 0.0).all():
        return 0.0, np.zeros(columns.shape[1] if free else 0)
    if not free:
        return 1.0 - float(np.add.reduce((target - columns[:, 0]) ** 2)) / whole, np.zeros(0)
    sizes = np.linalg.lstsq(columns / lengths, target, rcond=1e-6)[0] / lengths
    return 1.0 - float(np.add.reduce((target - columns @ sizes) ** 2)) / whole, sizes


def _value(fitted: FittedModel, coefficient: str, best: RefittedCandidate) -> float:
    """The value of a coefficient of the best candidate, estimated or held."""
    label = f"{best.candidate.effect.name}.{coefficient}"
    held = {p.name: p.start for p in fitted.problem.parameters}
    return float(fitted.estimates.get(label, held[label]))


def _before(
    workbench: LoopWorkbench, current: FittedModel, best: RefittedCandidate
) -> list[LinearisedTrajectory]:
    """Trajectories with the best candidate; an input at which it acts is as it was before it."""
    trajectories = workbench.trajectories(best.fitted)
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
        for new, old in zip(trajectories, workbench.trajectories(current), strict=True)
    ]
