"""Which of the structures that a search has accepted is its answer.

A search accepts what fits and predicts better than the structure before it. Later effects are
wrong more often than first ones: they live of what the first ones leave. So the answer is looked
for once more among all that was accepted, by refits with each part of the data left out: a
structure takes the place of a plainer one where it predicts the parts better in all, and most of
them one by one; what is plainer takes the place of a structure that does not. A step that is
refused does not end the walk: a model may get worse before it gets right.

What is held out chooses nothing. It may veto an answer, and then the one before it is asked.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.fitter import FittedModel
from cluster_est.closed_loop.selection.prediction import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.rounds import (
    AcceptedStructure,
    ComparedStructure,
    RejectionReason,
    SelectionResult,
)
from cluster_est.closed_loop.settings import LoopPart

BETTER_PARTS = 2.0 / 3.0
"""Share of the parts left out that a structure must predict better, of those that tell any
difference. By definition: most of them."""
TOLD_APART = 0.01
"""Difference of a part's squares, over the mean of the parts, below which it tells none. By
definition: an effect that acts in few parts changes nothing in the others."""


def answers(found: SelectionResult) -> list[SelectionResult]:
    """Return the answer of a search, and those that it took the place of, the last one first.

    The declared model, which is the first of all, is not among them; if it predicts best, none is.
    """
    chain = [0]
    for number in range(1, len(found.accepted)):
        if _replaces(found.accepted[number], found.accepted[chain[-1]]):
            chain.append(number)
    return [ending_at(found, number) for number in reversed(chain) if number]


def ending_at(found: SelectionResult, number: int) -> SelectionResult:
    """Return what a search had found when it accepted a structure; 0 is the declared model.

    What was accepted later did not predict better what was left out.
    """
    then, steps = found.accepted[number], found.steps[: number + 1]
    if number < len(found.accepted) - 1:
        steps = (*steps[:-1], replace(steps[-1], why=RejectionReason.REFITS))
    return replace(
        found,
        path=tuple(_not_the_answer(row, found, number) for row in found.path),
        current=then.model,
        prediction=then.prediction,
        rivals=then.rivals,
        steps=steps,
    )


def _not_the_answer(
    row: ComparedStructure, found: SelectionResult, number: int
) -> ComparedStructure:
    """The row of a structure, which is no longer accepted if it came after the answer."""
    later = [[c.label for c in each.model.added] for each in found.accepted[number + 1 :]]
    if not row.accepted or list(row.effects) not in later:
        return row
    return replace(row, accepted=False, stopped_by=LoopPart.ANSWER)


def _replaces(later: AcceptedStructure, earlier: AcceptedStructure) -> bool:
    """Return whether a structure takes the place of an earlier one; the plainer wins a tie."""
    if _complexity(later.model) > _complexity(earlier.model):
        return predicts_better(later.prediction, earlier.prediction)
    return not predicts_better(earlier.prediction, later.prediction)


def predicts_better(one: LeaveOneOutPrediction, other: LeaveOneOutPrediction) -> bool:
    """Return whether parts that were left out are predicted better: in all, and most of them."""
    if one.total >= other.total:
        return False
    change = one.squares - other.squares
    told = np.abs(change) > TOLD_APART * max(one.total, other.total) / len(change)
    return bool(np.mean(change[told] < 0.0) >= BETTER_PARTS) if told.any() else False


def _complexity(fitted: FittedModel) -> tuple[int, int]:
    return len(fitted.added), fitted.space.size
