"""Free curves: functions of no form of the library, as pairs of places and values.

A curve fits what several named effects would only patch, and explains nothing. So it is tried where
no named effect is accepted, and at the end of a search in the place of all that was. A search ends
with it: what it leaves is partly its own error, which named effects would only patch.
"""

from __future__ import annotations

import numpy as np

from cluster_est.closed_loop.screening.ranking import CandidateRanking
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import (
    best_that_passes,
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
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression


def refit_curves(
    workbench: LoopWorkbench, current: FittedModel, ranking: CandidateRanking
) -> list[RefittedCandidate]:
    """Refit the leading free curves, the best of them to convergence; it comes first."""
    thresholds = workbench.thresholds.refinement
    leaders = ranking.leaders(ranking.plain, thresholds.curves, free=True)
    starts = [step.start for step in first_steps(workbench, current, ranking, leaders)]
    brief = [f for f in workbench.fit(LoopStage.REFITS, starts, SHORT) if f is not None]
    brief.sort(key=lambda fitted: fitted.criterion(workbench.records))
    finished = workbench.fit(LoopStage.REFITS, [f.start for f in brief[:1]], full_refit(workbench))
    full = [new or old for new, old in zip(finished, brief, strict=False)]
    return [
        RefittedCandidate(f, f.criterion(workbench.records), i == 0)
        for i, f in enumerate([*full, *brief[1:]])
    ]


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
    end = best_that_passes(
        workbench, first, refit_curves(workbench, first.model, first.screening.ranking)
    )
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
