"""Beam search over structures: sets of effects, the best few of each size, grown by one each round.

A greedy search never sees two effects that explain the residual together where neither does alone,
or where a third one imitates both. So each round grows the accepted structure and others of its
size (B. T. Lowerre, The HARPY Speech Recognition System, Carnegie Mellon University, 1976).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.measured_noise import noise_of
from cluster_est.closed_loop.screening.evidence import CandidateEvidence, CandidateStage
from cluster_est.closed_loop.screening.screen import findings, refreshed, screen
from cluster_est.closed_loop.selection.accept import predict
from cluster_est.closed_loop.selection.declared_model import fit_declared
from cluster_est.closed_loop.selection.free_curves import curve_instead, refit_curves
from cluster_est.closed_loop.selection.gates import (
    best_that_passes,
    leaves_more_than_noise,
    reason_to_stop,
    useful_sse,
)
from cluster_est.closed_loop.selection.grow import best_distinct, grow
from cluster_est.closed_loop.selection.path import compared_structure, compared_structures
from cluster_est.closed_loop.selection.refinement.pairs import refit_pairs
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate, Rivals, rivals_of
from cluster_est.closed_loop.selection.refinement.refits import FIRST
from cluster_est.closed_loop.selection.refinement.useful_fit import UsefulFit, may_become_useful
from cluster_est.closed_loop.selection.restarts import refit_from_other_starts
from cluster_est.closed_loop.selection.revise import revise
from cluster_est.closed_loop.selection.rounds import (
    ComparedStructure,
    RoundEnd,
    RoundStart,
    SelectionResult,
    SelectionRound,
)
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.methods.least_squares.method import LeastSquares

AGAIN = LeastSquares(trials=1, max_iterations=15, ftol=1e-6, xtol=1e-7, differences="forward")


def beam_search(
    workbench: LoopWorkbench,
    base: FittedModel,
    numerical: Callable[[FittedModel], float] = lambda _: 0.0,
    *,
    again: bool = True,
) -> SelectionResult:
    """Add effects to the declared model while they earn it.

    Parameters
    ----------
    base
        The declared model, fitted.
    numerical
        Fall of the sum of squares that one effect more could owe to the error of the solver at a
        fitted model.
    again
        Begin once more where the declared model turns out to have been in a local minimum.
    """
    noise = noise_of(workbench, base.residuals)
    floor = workbench.noise_floor(noise)
    current, prediction = base, predict(workbench, base)
    base_prediction = prediction
    steps: list[SelectionRound] = []
    seen: list[CandidateEvidence] = []
    path: list[ComparedStructure] = []
    rivals: Rivals = {}
    beside: tuple[RefittedCandidate, ...] = ()
    first: RoundStart | None = None
    replaced = False
    passed = {base.structure}
    while True:
        number = len(steps) + 1
        _say_phase(workbench, current)
        screened = screen(workbench, current, number)
        begun = RoundStart(base, current, prediction, screened, floor, beside, numerical(current))
        first = first or begun
        end = _round(workbench, begun)
        steps.append(end.seen)
        seen += _noted(workbench, current, end, number)
        path += compared_structures(workbench, base, end, floor, number)
        won = end.won
        if won is None or end.prediction is None:
            curve = None if replaced else curve_instead(workbench, first, current, prediction)
            if curve is None:
                break
            replaced = True
            won, prediction, rivals = curve
            current, beside = won.fitted, ()
            seen = _with_curve(seen, won, won.criterion - base.criterion(workbench.records))
            path.append(compared_structure(workbench, base, current, floor, number))
            continue
        if again and not current.added and _was_local(workbench, base, won):
            restart = FitStart(base.problem, _declared_only(won), base.added)
            return beam_search(workbench, fit_declared(workbench, restart), numerical, again=False)
        grown, rivals = _revised(workbench, begun, end, won, rivals)
        predicted = predict(workbench, grown) if grown is not won.fitted else end.prediction
        if grown.structure != won.fitted.structure:
            path.append(compared_structure(workbench, base, grown, floor, number))
        if grown.structure in passed:
            break
        passed.add(grown.structure)
        current, prediction, beside = grown, predicted, end.compared
    return SelectionResult(
        base, current, base_prediction, prediction, rivals, tuple(steps), tuple(seen), noise,
        tuple(path),
    )  # fmt: skip


def _say_phase(workbench: LoopWorkbench, current: FittedModel) -> None:
    found, most = len(current.added), workbench.settings.max_effects
    which = f"effect {found + 1} of at most {most}" if found < most else "what is left"
    workbench.enter(f"looking for {which}")


def _revised(
    workbench: LoopWorkbench,
    begun: RoundStart,
    end: RoundEnd,
    won: RefittedCandidate,
    rivals: Rivals,
) -> tuple[FittedModel, Rivals]:
    """Return what has won a round, refitted and revised, and the rivals of its effects."""
    found = rivals_of(won, end.seen.contenders, workbench.thresholds.refinement)
    rivals = {**found, **rivals, **{name: own for name, own in found.items() if own[1]}}
    grown = won.fitted
    if _grows_several(workbench, grown, begun.floor):
        grown = refit_from_other_starts(workbench, begun.base, grown)
    if len(grown.added) > 1:
        grown, rivals = revise(workbench, begun, grown, rivals)
    return grown, rivals


def _round(workbench: LoopWorkbench, begun: RoundStart) -> RoundEnd:
    """Try to add something to a structure, or to others that are as large."""
    stop = reason_to_stop(workbench, begun)
    if stop is not None:
        return RoundEnd(SelectionRound(begun.screening, (), stop))
    grown = grow(workbench, begun, _parents(workbench, begun))
    single = best_that_passes(workbench, begun, grown)
    if single.won is None and single.seen.coloured:  # two would follow a disturbance the better
        return replace(single, compared=tuple(grown))
    if not _looks_for_two(workbench, begun, single):
        return replace(single, compared=tuple(grown))
    more = _two_more(workbench, begun, grown if single.won is None else ())
    best = _better(workbench, begun, single, best_that_passes(workbench, begun, more))
    curves: list[RefittedCandidate] = []
    if best.won is None:
        curves = refit_curves(workbench, begun)
        curved = best_that_passes(workbench, begun, curves)
        best = curved if curved.won is not None else best
    return replace(best, compared=(*grown, *more, *curves))


def _parents(workbench: LoopWorkbench, begun: RoundStart) -> tuple[FittedModel, ...]:
    """The accepted structure, and where it leaves more than noise, others as large."""
    if not begun.beside or not _grows_several(workbench, begun.model, begun.floor):
        return (begun.model,)
    size = len(begun.model.added)
    beside = [c for c in begun.beside if len(c.fitted.added) == size]
    return best_distinct(workbench, begun.base, beside, first=begun.model)


def _grows_several(workbench: LoopWorkbench, fitted: FittedModel, floor: float) -> bool:
    """Return whether the search is a wide one, and has something left to look for."""
    return workbench.settings.beam > 1 and leaves_more_than_noise(workbench, fitted, floor)


def _looks_for_two(workbench: LoopWorkbench, begun: RoundStart, single: RoundEnd) -> bool:
    """Return whether two effects at once are worth a look: no single one does most of it."""
    settings = workbench.settings
    hard = workbench.thresholds.selection.hard
    room = len(begun.model.added) + 2 <= settings.max_effects
    return settings.pairs and room and not (single.won is not None and single.seen.closed >= hard)


def _two_more(
    workbench: LoopWorkbench,
    begun: RoundStart,
    singles: Sequence[RefittedCandidate],
) -> list[RefittedCandidate]:
    """Structures of two effects more: from pairs of directions, and grown from single ones."""
    useful = UsefulFit(sse=useful_sse(workbench, begun, len(begun.model.added) + 2))
    pairs = refit_pairs(workbench, begun.model, begun.screening.ranking, begun.floor, useful)
    found = {c.fitted.structure: c for c in pairs}
    if _grows_several(workbench, begun.model, begun.floor):
        parents = best_distinct(workbench, begun.base, singles)
        for contender in grow(workbench, begun, parents, known=tuple(found)):
            found.setdefault(contender.fitted.structure, contender)
    return sorted(found.values(), key=lambda c: c.criterion)


def _better(
    workbench: LoopWorkbench, begun: RoundStart, single: RoundEnd, double: RoundEnd
) -> RoundEnd:
    """One effect more or two, which must pay for the choice among so many pairs."""
    if double.won is None:
        return single
    price = workbench.thresholds.selection.pair_price * np.log(begun.screening.count)
    if single.won is not None and double.won.criterion + price > single.won.criterion:
        return single
    return double


def _was_local(workbench: LoopWorkbench, base: FittedModel, won: RefittedCandidate) -> bool:
    """Return whether the declared model does better from the new parameters."""
    start = FitStart(base.problem, _declared_only(won), base.added)
    useful = UsefulFit(sse=workbench.thresholds.selection.local_minimum * base.sse)
    (brief,) = workbench.fit(LoopStage.DECLARED_AGAIN, [start], FIRST)
    if brief is None or not may_become_useful(workbench, brief, useful):
        return False
    (fit,) = workbench.fit(LoopStage.DECLARED_AGAIN, [brief.start], AGAIN)
    return fit is not None and fit.sse < useful.sse


def _declared_only(won: RefittedCandidate) -> dict[str, float]:
    names = [c.effect.name for c in won.fitted.added]
    estimates = won.fitted.estimates.items()
    return {k: v for k, v in estimates if not any(k.startswith(f"{n}.") for n in names)}


def _noted(
    workbench: LoopWorkbench, current: FittedModel, end: RoundEnd, number: int
) -> list[CandidateEvidence]:
    """The candidates of a round, with how far each came."""
    found = findings(end.seen.screening.ranking, current, number)
    base = current.criterion(workbench.records)
    reached = [
        (c, CandidateStage.REFITTED)
        for c in end.compared
        if c.fitted.structure - {c.candidate.effect.name} == current.structure
    ]
    if end.won is not None:
        reached.append((end.won, CandidateStage.ACCEPTED))
    for contender, stage in reached:
        for candidate in contender.fitted.added:
            name = candidate.effect.name
            if name in found:
                found[name] = refreshed(found[name], stage, contender.criterion - base)
    return list(found.values())


def _with_curve(
    seen: Sequence[CandidateEvidence], curve: RefittedCandidate, criterion: float
) -> list[CandidateEvidence]:
    """The candidates, with the one of the first round that took the place of all effects."""
    own, effect = curve.candidate, curve.candidate.effect
    place = (1, str(own.site), own.form.name, effect.variables)
    return [
        refreshed(each, CandidateStage.ACCEPTED, criterion)
        if (each.step, each.site, each.form, each.variables) == place
        else each
        for each in seen
    ]
