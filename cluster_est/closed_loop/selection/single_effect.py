"""One effect in the place of several: a free curve, or a form of the library that it leads to.

The first step of a large effect may point anywhere, so that several small ones patch what one large
one does. A curve that is refitted from coarse to fine finds its way to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.free_curves import (
    coarse_curves,
    finer_curves,
    refit_named,
    switched_curves,
)
from cluster_est.closed_loop.selection.gates import (
    best_that_passes,
    can_be_claimed,
    leaves_more_than_noise,
    reason_to_stop,
)
from cluster_est.closed_loop.selection.refinement.refine import (
    RefittedCandidate,
    Rivals,
    rivals_of,
)
from cluster_est.closed_loop.selection.refinement.useful_fit import UsefulFit
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance, fit_autoregression


@dataclass(frozen=True)
class SingleEffects:
    """Effects that may take the place of all that a search adds, refitted to the declared model.

    Attributes
    ----------
    curves, named
        Free curves, and forms of the library of the argument of the best of them.
    fine
        Finer curves have been refitted too, where those led on.
    """

    curves: tuple[RefittedCandidate, ...] = field(default=(), repr=False)
    named: tuple[RefittedCandidate, ...] = field(default=(), repr=False)
    fine: bool = False


@dataclass(frozen=True)
class SingleEffect:
    """One that takes their place.

    Attributes
    ----------
    won, prediction
        The declared model with it, and its leave-one-out prediction.
    rivals
        The effects that the data leave possible in its place.
    """

    won: RefittedCandidate = field(repr=False)
    prediction: LeaveOneOutPrediction
    rivals: Rivals = field(repr=False)


def may_be_single(workbench: LoopWorkbench, first: RoundStart, current: FittedModel) -> bool:
    """Return whether another effect may take the place of those that were added.

    They are several, or leave more than noise, and something is missing at all.
    """
    patched = len(current.added) > 1 or leaves_more_than_noise(workbench, current, first.floor)
    free = any(candidate.form.free for candidate in current.added)
    return patched and not free and reason_to_stop(workbench, first) is None


def single_effects(
    workbench: LoopWorkbench,
    first: RoundStart,
    current: FittedModel,
    known: SingleEffects | None = None,
    *,
    whole: bool = False,
) -> SingleEffects:
    """Refit the single effects that could fit better than a structure does.

    Curves are made finer only where they may be taken, see `single_instead`, and where there is
    something to be gained: one or two effects leave more than noise, or three look like patches.
    The curve of a switch is among them where nothing found may be claimed.

    Parameters
    ----------
    first
        The start of the search's first round.
    current
        The model with the effects that were added.
    known
        Those that have been refitted already.
    whole
        As in `single_instead`.
    """
    if known is None:
        curves = coarse_curves(workbench, first)
        known = SingleEffects(tuple(curves), tuple(refit_named(workbench, first, curves)))
    early = whole and len(current.added) < 2
    gains = len(current.added) > 2 or leaves_more_than_noise(workbench, current, first.floor)
    if known.fine or early or not gains:
        return known
    if not whole and not can_be_claimed(workbench, first, current):
        switched = switched_curves(workbench, first)
        known = replace(known, curves=(*known.curves, *switched))
    useful = UsefulFit(criterion=current.criterion(workbench.records))
    finer = finer_curves(workbench, first, known.curves, useful)
    curves = sorted((*known.curves, *finer), key=lambda c: c.criterion)
    return replace(known, curves=tuple(curves), fine=True)


def single_instead(
    workbench: LoopWorkbench,
    first: RoundStart,
    current: FittedModel,
    prediction: LeaveOneOutPrediction,
    singles: SingleEffects,
    *,
    whole: bool = False,
) -> SingleEffect | None:
    """Return the single effect that takes the place of all that were added; None if they stay.

    It must fit better, also if what is left is noise as coloured as it looks, and predict better. A
    curve must fit better by the price of a choice among all pairs, and waits for two effects: as a
    function of one argument, it imitates every sum of two that have this one.

    Parameters
    ----------
    first
        The start of the search's first round.
    current, prediction
        The model with the effects that were added, and its leave-one-out prediction.
    singles
        See `single_effects`.
    whole
        Take only what leaves no more than noise.
    """
    price = workbench.thresholds.selection.pair_price * float(np.log(first.screening.count))

    def fits_better(contender: RefittedCandidate, least: float) -> bool:
        if contender.candidate.form.free and whole and len(current.added) < 2:
            return False
        if whole and leaves_more_than_noise(workbench, contender.fitted, first.floor):
            return False
        return min(_falls(workbench, current, contender.fitted)) > least

    for contenders, least in ((singles.named, 0.0), (singles.curves, price)):
        if not any(fits_better(contender, least) for contender in contenders):
            continue  # the gates cost simulations
        end = best_that_passes(workbench, first, contenders)
        if end.won is None or end.prediction is None or not fits_better(end.won, least):
            continue
        if end.prediction.total < prediction.total:
            rivals = rivals_of(end.won, end.seen.contenders, workbench.thresholds.refinement)
            return SingleEffect(end.won, end.prediction, rivals)
    return None


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
