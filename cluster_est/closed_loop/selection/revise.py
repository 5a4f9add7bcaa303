"""Whether what was added before is still the best, and needed, now that more is known."""

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
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench

SWEEPS = 2
"""How often all effects are asked at most whether another is better."""
SWAP = 4.0
"""By how much a criterion must fall for an earlier effect to be replaced."""

Rivals = dict[str, tuple[RefittedCandidate, list[RefittedCandidate]]]
"""For each added effect, by name, the model that brought it in and those that it won against."""


def revise(
    bench: LoopWorkbench,
    grown: FittedModel,
    count: int,
    floor: float,
    rivals: Rivals,
) -> FittedModel:
    """Ask of each earlier effect whether another is better now, and whether it is needed."""
    for sweep in range(SWEEPS):
        before = grown
        for position in range(len(grown.added) - (sweep == 0)):
            grown = _swap(bench, grown, position, floor, rivals)
        if grown is before:
            break
    for position in reversed(range(len(grown.added))):
        if len(grown.added) < 2:
            break
        (rest,) = bench.fit("drop", [grown.start.minus(position)], FULL)
        price = 2.0 * np.log(count)
        if (
            rest is not None
            and rest.criterion(bench.records) < grown.criterion(bench.records) + price
        ):
            grown = rest
    return grown


def _swap(
    bench: LoopWorkbench,
    grown: FittedModel,
    position: int,
    floor: float,
    rivals: Rivals,
) -> FittedModel:
    """The model with a better effect in the place of one, if there is a better one."""
    (rest,) = bench.fit("swap", [grown.start.minus(position)], FULL)
    if rest is None:
        return grown
    screening = screen(bench, rest, 50 + position)
    contenders = [
        c for c in refit(bench, rest, screening, floor, wide=False)
        if c.candidate.form.family != "table"
    ]  # fmt: skip
    if not contenders or contenders[0].criterion >= grown.criterion(bench.records) - SWAP:
        return grown
    won = plainest(contenders)
    if not stays_bounded(bench, won.fitted, rest):
        return grown
    rivals[won.candidate.effect.name] = (won, alternatives(contenders, won))
    # in its old place, so that the other positions still mean the same effects
    return won.fitted.moved(position)
