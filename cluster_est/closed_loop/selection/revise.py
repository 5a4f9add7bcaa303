"""Revision of effects that were added before, now that more is known."""

from __future__ import annotations

import numpy as np

from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.accept import stays_bounded
from cluster_est.closed_loop.selection.refine import (
    FULL,
    RefittedCandidate,
    alternatives,
    plainest,
    refit,
)
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench

Rivals = dict[str, tuple[RefittedCandidate, list[RefittedCandidate]]]
"""For each added effect, by name, the model that brought it in and those that it won against."""


def revise(
    workbench: LoopWorkbench,
    grown: FittedModel,
    count: int,
    floor: float,
    rivals: Rivals,
) -> FittedModel:
    """Replace earlier effects that others are better than now, and drop those not needed."""
    thresholds = workbench.thresholds.revision
    for sweep in range(thresholds.sweeps):
        before = grown
        for position in range(len(grown.added) - (sweep == 0)):
            grown = _swap(workbench, grown, position, floor, rivals)
        if grown is before:
            break
    for position in reversed(range(len(grown.added))):
        if len(grown.added) < 2:
            break
        (rest,) = workbench.fit(LoopStage.DROP, [grown.start.minus(position)], FULL)
        price = thresholds.drop_price * np.log(count)
        if (
            rest is not None
            and rest.criterion(workbench.records) < grown.criterion(workbench.records) + price
        ):
            grown = rest
    return grown


def _swap(
    workbench: LoopWorkbench,
    grown: FittedModel,
    position: int,
    floor: float,
    rivals: Rivals,
) -> FittedModel:
    """The model with a better effect in the place of one, if there is a better one."""
    (rest,) = workbench.fit(LoopStage.SWAP, [grown.start.minus(position)], FULL)
    if rest is None:
        return grown
    screening = screen(workbench, rest, 50 + position)
    contenders = [
        c for c in refit(workbench, rest, screening, floor, wide=False)
        if not c.candidate.form.free
    ]  # fmt: skip
    swap = workbench.thresholds.revision.swap
    if not contenders or contenders[0].criterion >= grown.criterion(workbench.records) - swap:
        return grown
    won = plainest(contenders, workbench.thresholds.refinement)
    if not stays_bounded(workbench, won.fitted, rest):
        return grown
    rivals[won.candidate.effect.name] = (
        won,
        alternatives(contenders, won, workbench.thresholds.refinement),
    )
    # in its old place, so that the other positions still mean the same effects
    return won.fitted.moved(position)
