"""Growth of structures: one effect more for each of several."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from cluster_est.closed_loop.selection.accept import can_be_linearised
from cluster_est.closed_loop.selection.gates import useful_sse
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate, refit
from cluster_est.closed_loop.selection.refinement.refits import full_refit
from cluster_est.closed_loop.selection.refinement.same_argument import refit_same_argument
from cluster_est.closed_loop.selection.refinement.switch_widths import refit_switch_widths
from cluster_est.closed_loop.selection.refinement.useful_fit import UsefulFit
from cluster_est.closed_loop.selection.rounds import RoundStart
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from workers.messages import FloatArray


def grow(
    workbench: LoopWorkbench,
    begun: RoundStart,
    parents: Sequence[FittedModel],
    known: Collection[frozenset[str]] = (),
) -> list[RefittedCandidate]:
    """Refit structures with one effect more than each parent has; the best first.

    A structure that several parents lead to is refitted from the first of them alone, and one that
    is known already not at all. What cannot come to be of any use is refitted no further: from the
    second parent on it must come near the best structure so far.
    """
    found: dict[frozenset[str], RefittedCandidate] = {}
    large = _leaves_much(workbench, begun)
    for parent in parents:
        accepted = parent is begun.model
        if not accepted and not can_be_linearised(workbench, parent):
            continue
        ranking = begun.screening.ranking if accepted else begun.visited.ranking(workbench, parent)
        best = min((c.criterion for c in found.values()), default=np.inf)
        useful = UsefulFit(
            best + workbench.thresholds.refinement.alternative,
            useful_sse(workbench, begun, len(parent.added) + 1),
        )
        earlier = begun.visited.grown_from(parent)
        contenders = refit(
            workbench,
            parent,
            ranking,
            begun.floor,
            wide=accepted,
            further=accepted and large,
            known={*known, *found},
            done={c.fitted.structure for c in earlier},
            useful=useful,
        )
        contenders = sorted([*contenders, *earlier], key=lambda c: c.criterion)
        contenders += refit_same_argument(workbench, parent, ranking, contenders)
        contenders = refit_switch_widths(workbench, contenders, useful.criterion)
        begun.visited.add(parent, contenders)
        for contender in contenders:
            found.setdefault(contender.fitted.structure, contender)
    return sorted(found.values(), key=lambda c: c.criterion)


def _leaves_much(workbench: LoopWorkbench, begun: RoundStart) -> bool:
    """Return whether what is missing is still large: the score of a small effect says enough."""
    closed = begun.base.sse - begun.model.sse
    share = workbench.thresholds.refinement.closes
    return closed < share * (begun.base.sse - begun.floor)


def best_distinct(
    workbench: LoopWorkbench,
    base: FittedModel,
    contenders: Sequence[RefittedCandidate],
    first: FittedModel | None = None,
) -> tuple[FittedModel, ...]:
    """The beam: the best structures whose predictions differ, refitted to convergence.

    Structures that predict the same leave the same residual, and so lead to the same next effects:
    a second name for a structure that is in the beam already would be a place lost.

    Parameters
    ----------
    base
        The declared model, fitted: predictions are compared by how they differ from its own.
    contenders
        The structures to choose from.
    first
        A structure that has its place in any case.
    """
    width = workbench.settings.beam
    kept = [] if first is None else [first]
    changes = [_direction(base, fitted) for fitted in kept]
    for contender in sorted(contenders, key=lambda c: c.criterion):
        if len(kept) >= width:
            break
        change = _direction(base, contender.fitted)
        alike = [float(np.add.reduce(change * other)) for other in changes]
        if (
            contender.candidate.form.free
            or max(alike, default=0.0) > workbench.thresholds.beam.alike
        ):
            continue
        kept.append(contender.fitted)
        changes.append(change)
    rough = {id(c.fitted) for c in contenders if not c.full}
    asked = [fitted.start for fitted in kept if id(fitted) in rough]
    finished = iter(workbench.fit(LoopStage.REFITS, asked, full_refit(workbench)))
    return tuple((next(finished) or f) if id(f) in rough else f for f in kept)


def _direction(base: FittedModel, fitted: FittedModel) -> FloatArray:
    """The change of the residuals from the declared model's, of length 1."""
    change = fitted.residuals - base.residuals
    return change / max(float(np.sqrt(np.add.reduce(change**2))), 1e-300)
