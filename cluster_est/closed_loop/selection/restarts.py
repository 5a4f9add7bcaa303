"""Refits of a structure from other starts: a local minimum looks like a wrong name."""

from __future__ import annotations

from collections.abc import Iterator

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.selection.accept import stays_bounded
from cluster_est.closed_loop.selection.refinement.refine import FULL, SHORT
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench


def refit_from_other_starts(
    workbench: LoopWorkbench, declared: FittedModel, grown: FittedModel
) -> FittedModel:
    """Refit from the declared parameters, and with shapes at every point of their grids.

    Returns
    -------
    FittedModel
        The same structure where it fits best.
    """
    starts = list(_other_starts(declared, grown))
    brief = [f for f in workbench.fit(LoopStage.OTHER_STARTS, starts, SHORT) if f is not None]
    if not brief:
        return grown
    best = min(brief, key=lambda fitted: fitted.sse)
    (finished,) = workbench.fit(LoopStage.OTHER_STARTS, [best.start], FULL)
    if finished is None or finished.sse >= grown.sse:
        return grown
    return finished if stays_bounded(workbench, finished, declared) else grown


def _other_starts(declared: FittedModel, grown: FittedModel) -> Iterator[FitStart]:
    values = grown.estimates
    yield FitStart(grown.problem, values | declared.estimates, grown.added)
    for candidate in grown.added:
        for shape in _shapes(candidate):
            yield FitStart(
                grown.problem,
                values | {label: value for label, value in shape.items() if label in values},
                grown.added,
            )


def _shapes(candidate: EffectCandidate) -> list[dict[str, float]]:
    """What is no strength, at each point of the candidate's grid; nothing where that is one."""
    if len(candidate.grid) < 2:
        return []
    names = [c.name for c in candidate.form.coefficients]
    return [
        {
            f"{candidate.effect.name}.{name}": value
            for name, value in zip(names, row, strict=True)
            if name not in candidate.strengths
        }
        for row in candidate.grid
    ]
