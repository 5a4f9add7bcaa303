"""The path of a search: the structures that it compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.selection.rounds import ComparedStructure, RoundEnd
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench


def compared_structures(
    workbench: LoopWorkbench, base: FittedModel, end: RoundEnd, floor: float, step: int
) -> list[ComparedStructure]:
    """The structures of a round, the best first.

    Parameters
    ----------
    base
        The declared model, fitted.
    end
        Of the round.
    floor
        Sum of squares that the noise alone would leave.
    step
        The number of the round.
    """
    return [
        replace(
            compared_structure(workbench, base, contender.fitted, floor, step),
            converged=contender.full,
            accepted=contender is end.won,
        )
        for contender in sorted(end.compared, key=lambda c: c.criterion)
    ]


def compared_structure(
    workbench: LoopWorkbench, base: FittedModel, fitted: FittedModel, floor: float, step: int
) -> ComparedStructure:
    """A structure that was accepted, as a row; see `compared_structures`."""
    records = workbench.records
    gap = base.sse - floor
    return ComparedStructure(
        step=step,
        effects=tuple(candidate.label for candidate in fitted.added),
        criterion=fitted.criterion(records) - base.criterion(records),
        closed=(base.sse - fitted.sse) / gap if gap > 0.0 else np.nan,
        converged=True,
        accepted=True,
        relative_steps=fitted.steps / base.steps if base.steps and fitted.steps else np.nan,
    )
