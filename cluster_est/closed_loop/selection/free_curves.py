"""Free curves: functions of no form of the library, as pairs of places and values.

A curve fits what several named effects would only patch, and explains nothing. So it is tried where
no named effect is accepted, and at the end of a search in the place of all that was. A search ends
with it: what it leaves is partly its own error, which named effects would only patch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.finer_curves import finer_form, refined
from cluster_est.closed_loop.screening.curves import leading_places, rank_curves
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction, can_be_linearised
from cluster_est.closed_loop.selection.gates import (
    best_that_passes,
    claimable_sse,
    leaves_more_than_noise,
    reason_to_stop,
)
from cluster_est.closed_loop.selection.refinement.first_steps import first_steps
from cluster_est.closed_loop.selection.refinement.refine import (
    RefittedCandidate,
    Rivals,
    rivals_of,
)
from cluster_est.closed_loop.selection.refinement.refits import SHORT, full_refit
from cluster_est.closed_loop.selection.refinement.useful_fit import UsefulFit, may_become_useful
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression


def refit_curves(workbench: LoopWorkbench, begun: RoundStart) -> list[RefittedCandidate]:
    """Refit free curves at the leading places, from coarse to fine; the best comes first.

    A fine curve has many values, and its first step leads astray where the effect is large. So each
    place begins with few, and where that leaves more than noise, goes on with twice as many from
    what it has come to, as long as the criterion falls and a claim is in reach. Places that fall
    behind are left.
    """
    curves = rank_curves(workbench, begun.model, begun.screening.ranking)
    leaders = leading_places(curves)[: workbench.thresholds.refinement.curves]
    starts = [step.start for step in first_steps(workbench, begun.model, curves, leaders)]
    brief = [f for f in workbench.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    going = _finished(workbench, brief)
    seen = list(going)
    while going:
        going = _finer_fits(workbench, begun, going)
        seen += going
        best = min((f.criterion(workbench.records) for f in seen), default=np.inf)
        near = best + workbench.thresholds.refinement.alternative
        going = [f for f in going if f.criterion(workbench.records) <= near]
    made = [RefittedCandidate(f, f.criterion(workbench.records), True) for f in seen]
    return sorted(made, key=lambda c: c.criterion)


def _finished(workbench: LoopWorkbench, fits: Sequence[FittedModel]) -> list[FittedModel]:
    """Refit to convergence; what cannot be stays as it is."""
    finished = workbench.fit(LoopStage.REFITS, [f.start for f in fits], full_refit(workbench))
    return [new or old for new, old in zip(finished, fits, strict=True)]


def _finer_fits(
    workbench: LoopWorkbench, begun: RoundStart, fits: Sequence[FittedModel]
) -> list[FittedModel]:
    """Refit each curve with twice as many steps, where it leaves more than noise.

    Those whose criterion does not fall, or that do not lead to a claim, are left out.
    """
    rough = [f for f in fits if leaves_more_than_noise(workbench, f, begun.floor)]
    asked = [(f, start) for f in rough if (start := _finer_start(workbench, f)) is not None]
    brief = workbench.fit(LoopStage.REFITS, [start for _, start in asked], SHORT)
    useful = UsefulFit(sse=claimable_sse(workbench, begun, workbench.settings.max_effects))
    hopeful = [
        (old, new)
        for (old, _), new in zip(asked, brief, strict=True)
        if new is not None and may_become_useful(workbench, new, useful)
    ]
    finished = _finished(workbench, [new for _, new in hopeful])
    records = workbench.records
    return [
        new
        for (old, _), new in zip(hopeful, finished, strict=True)
        if new.criterion(records) < old.criterion(records)
    ]


def _finer_start(workbench: LoopWorkbench, fitted: FittedModel) -> FitStart | None:
    """The model with a finer curve that says the same; None where there is none."""
    curve = fitted.added[-1]
    form = finer_form(curve)
    if form is None or not can_be_linearised(workbench, fitted):
        return None
    held = {p.name: p.start for p in fitted.problem.parameters if p.fixed}
    known = {**fitted.estimates, **held}
    values = [known[f"{curve.effect.name}.{c.name}"] for c in curve.form.coefficients]
    finer, heights = refined(curve, values, workbench.trajectories(fitted), form)
    return fitted.start.minus(len(fitted.added) - 1).plus(finer, heights)


def curve_instead(
    workbench: LoopWorkbench,
    first: RoundStart,
    current: FittedModel,
    prediction: LeaveOneOutPrediction,
) -> tuple[RefittedCandidate, LeaveOneOutPrediction, Rivals] | None:
    """One curve in the place of all effects that a search has added.

    It takes their place where something may be missing at all, and they are several, or leave more
    than noise, and it fits better than they do by the price of a choice among all pairs, also if
    what is left is noise as coloured as it looks, and predicts better.

    Parameters
    ----------
    first
        The start of the search's first round.
    current, prediction
        The model that the search has ended with.

    Returns
    -------
    RefittedCandidate, LeaveOneOutPrediction, Rivals
        The declared model with the curve, its prediction, and the curves that the data leave
        possible in its place; None where the effects stay.
    """
    if reason_to_stop(workbench, first) is not None:
        return None
    patched = len(current.added) > 1 or leaves_more_than_noise(workbench, current, first.floor)
    if not patched or any(c.form.free for c in current.added):
        return None
    end = best_that_passes(workbench, first, refit_curves(workbench, first))
    if end.won is None or end.prediction is None:
        return None
    price = workbench.thresholds.selection.pair_price * float(np.log(first.screening.count))
    falls = min(_falls(workbench, current, end.won.fitted))
    better = end.prediction.total < prediction.total
    if not (falls > price and better):
        return None
    rivals = rivals_of(end.won, end.seen.contenders, workbench.thresholds.refinement)
    return end.won, end.prediction, rivals


def coloured_criterion(fitted: FittedModel, records: StackedRecords, order: int) -> float:
    """The criterion where what is left is an autoregression of this order, for each output.

    Of coloured residuals the plain criterion counts samples that say the same as so many pieces of
    evidence, and many coefficients look as if they paid for themselves.
    """
    coefficients = fit_autoregression(fitted.residuals, records, order)
    likelihood = deviance(fitted.residuals, records, coefficients)
    return float(likelihood + fitted.space.size * np.log(len(fitted.residuals)))


def _falls(
    workbench: LoopWorkbench, before: FittedModel, after: FittedModel
) -> tuple[float, float]:
    """By how much the criterion falls: for white noise, and for noise as coloured as the rest."""
    records, order = workbench.records, workbench.thresholds.screening.autoregression
    coloured = [coloured_criterion(fitted, records, order) for fitted in (before, after)]
    return before.criterion(records) - after.criterion(records), coloured[0] - coloured[1]
