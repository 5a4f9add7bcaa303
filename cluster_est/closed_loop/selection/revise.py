"""Revision of effects that were added before, now that more is known."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from cluster_est.closed_loop.selection.accept import can_be_linearised, is_usable
from cluster_est.closed_loop.selection.gates import claimable_sse
from cluster_est.closed_loop.selection.refinement.refine import (
    RefittedCandidate,
    Rivals,
    ending_with,
    plainest,
    refit,
    rivals_of,
)
from cluster_est.closed_loop.selection.refinement.refits import full_refit
from cluster_est.closed_loop.selection.refinement.same_argument import refit_same_argument
from cluster_est.closed_loop.selection.refinement.switch_widths import refit_switch_widths
from cluster_est.closed_loop.selection.refinement.useful_fit import UsefulFit
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.selection.waves import believable
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench


def revise(
    workbench: LoopWorkbench,
    begun: RoundStart,
    grown: FittedModel,
    rivals: Rivals,
) -> tuple[FittedModel, Rivals]:
    """Replace earlier effects that others are better than now, and drop those not needed.

    Parameters
    ----------
    begun
        The round that it was chosen in.
    grown
        The structure, fitted.
    rivals
        Of its effects.

    Returns
    -------
    FittedModel
        The structure that is left.
    Rivals
        Of its effects; those of others may be among them.
    """
    thresholds = workbench.thresholds.revision
    saved = thresholds.drop_price * float(np.log(begun.screening.count))  # by an effect less
    for sweep in range(thresholds.sweeps):
        before = grown
        for position in range(len(grown.added) - (sweep == 0)):
            found = _instead(workbench, begun, grown, (position,), -thresholds.swap)
            if found is not None:
                # in its old place, so that the other positions still mean the same effects
                grown, rivals = found[0].fitted.moved(position), {**rivals, **found[1]}
        if grown is before:
            break
    if workbench.settings.beam > 1:
        grown, rivals = _merged(workbench, begun, grown, saved, rivals)
    return _without_needless(workbench, grown, saved), rivals


def _merged(
    workbench: LoopWorkbench, begun: RoundStart, grown: FittedModel, saved: float, rivals: Rivals
) -> tuple[FittedModel, Rivals]:
    """The structure with one effect in the place of two, as long as that pays."""
    for pair in combinations(range(len(grown.added)), 2):
        found = _instead(workbench, begun, grown, pair, saved)
        if found is not None:
            return _merged(workbench, begun, found[0].fitted, saved, {**rivals, **found[1]})
    return grown, rivals


def _without_needless(workbench: LoopWorkbench, grown: FittedModel, saved: float) -> FittedModel:
    """The structure without the effects that do not pay for themselves; one is left at least."""
    for position in reversed(range(len(grown.added))):
        if len(grown.added) < 2:
            break
        (rest,) = workbench.fit(
            LoopStage.DROP, [grown.start.minus(position)], full_refit(workbench)
        )
        if rest is not None and (
            rest.criterion(workbench.records) < grown.criterion(workbench.records) + saved
        ):
            grown = rest
    return grown


def _instead(
    workbench: LoopWorkbench,
    begun: RoundStart,
    grown: FittedModel,
    positions: tuple[int, ...],
    rise: float,
) -> tuple[RefittedCandidate, Rivals] | None:
    """The best effect in the place of some, with its rivals.

    Other functions of the argument of the one that is replaced start from where that one stands:
    without it the model may be far from there.

    None if the criterion would rise by more than what it may, or it cannot be gone on from, or
    nothing can be added to it and too little is closed for a claim.
    """
    start = grown.start
    for position in reversed(positions):
        start = start.minus(position)
    (rest,) = workbench.fit(LoopStage.SWAP, [start], full_refit(workbench))
    if rest is None or not can_be_linearised(workbench, rest):
        return None
    thresholds = workbench.thresholds.refinement
    most = grown.criterion(workbench.records) + rise
    claimable = claimable_sse(workbench, begun, len(rest.added) + 1)
    useful = UsefulFit(most + thresholds.alternative, claimable)
    ranking = begun.visited.ranking(workbench, rest)
    earlier = begun.visited.grown_from(rest)
    refitted = refit(
        workbench,
        rest,
        ranking,
        begun.floor,
        wide=False,
        further=False,
        done={c.fitted.structure for c in earlier},
        useful=useful,
    )
    refitted += earlier
    if len(positions) == 1:
        own = RefittedCandidate(grown, grown.criterion(workbench.records), True)
        there = ending_with(own, grown.added[positions[0]].effect.name)
        refitted += refit_same_argument(workbench, rest, ranking, [there])
    refitted = refit_switch_widths(workbench, refitted, useful.criterion)
    begun.visited.add(rest, refitted)
    contenders = believable(workbench, rest, refitted)
    if not contenders or contenders[0].criterion >= most:
        return None
    won = plainest(contenders, thresholds)
    name = won.candidate.effect.name
    if not is_usable(workbench, won.fitted, rest):
        return None
    return won, {name: rivals_of(won, contenders, thresholds)[name]}
