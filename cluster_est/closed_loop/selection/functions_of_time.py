"""Functions of time alone are taken out again where more than noise is left beside them.

A drift or a wave in time follows the slow part of whatever disturbs an experiment: it closes most
of the gap to the noise, and predicts what was left out, without being what is missing. One that is
really there leaves noise.
"""

from __future__ import annotations

from dataclasses import replace

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.accept import is_usable, predict
from cluster_est.closed_loop.selection.path import compared_structure
from cluster_est.closed_loop.selection.refinement.refits import full_refit
from cluster_est.closed_loop.selection.rounds import (
    RejectionReason,
    SelectionResult,
    SelectionRound,
)
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import LoopWorkbench


def functions_of_time(found: SelectionResult) -> tuple[EffectCandidate, ...]:
    """Return the effects that were added and are functions of time alone."""
    return tuple(c for c in found.current.added if c.form.of_time_alone)


def without_functions_of_time(workbench: LoopWorkbench, found: SelectionResult) -> SelectionResult:
    """Take the functions of time out of a result, and refit what stays.

    Where the other effects cannot be simulated without them, or run away, nothing stays.
    """
    start = found.current.start
    for position in reversed(range(len(found.current.added))):
        if found.current.added[position].form.of_time_alone:
            start = start.minus(position)
    kept, prediction, screening = found.base, found.base_prediction, found.steps[0].screening
    gone = {c.label for c in functions_of_time(found)}
    path = tuple(
        replace(row, accepted=row.accepted and not gone & {*row.effects}) for row in found.path
    )
    if start.added:
        (refitted,) = workbench.fit(LoopStage.DROP, [start], full_refit(workbench))
        if refitted is not None and is_usable(workbench, refitted, found.base):
            number, floor = len(found.steps) + 1, workbench.noise_floor(found.noise)
            kept, prediction = refitted, predict(workbench, refitted)
            screening = screen(workbench, refitted, number)
            path += (compared_structure(workbench, found.base, refitted, floor, number),)
    seen = SelectionRound(screening, (), RejectionReason.FUNCTIONS_OF_TIME)
    rivals = {name: own for name, own in found.rivals.items() if name in kept.structure}
    return replace(
        found,
        current=kept,
        prediction=prediction,
        rivals=rivals,
        steps=(*found.steps, seen),
        path=path,
    )
