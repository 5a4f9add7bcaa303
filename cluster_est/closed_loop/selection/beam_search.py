"""Beam search over structures: sets of effects, the best few of each size, grown by one each round.

A greedy search never sees two effects that explain the residual together where neither does alone,
or where a third one imitates both. So each round grows the accepted structure and others of its
size (B. T. Lowerre, The HARPY Speech Recognition System, Carnegie Mellon University, 1976).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.output_noise import noise_of
from cluster_est.closed_loop.screening.evidence import CandidateEvidence
from cluster_est.closed_loop.screening.screen import ScreeningResult, screen
from cluster_est.closed_loop.selection.free_curves import (
    SingleEffects,
    may_be_single,
    refit_curves,
    refit_named,
    single_effects,
    single_instead,
)
from cluster_est.closed_loop.selection.gates import (
    best_that_passes,
    can_be_claimed,
    leaves_more_than_noise,
    reason_to_stop,
    useful_sse,
)
from cluster_est.closed_loop.selection.linear_model import UsefulFit, may_become_useful
from cluster_est.closed_loop.selection.moves import best_distinct, grow, refit_pairs, revise
from cluster_est.closed_loop.selection.prediction import LeaveOneOutPrediction, predict
from cluster_est.closed_loop.selection.refits import (
    FIRST,
    RefittedCandidate,
    Rivals,
    VisitedModels,
    rivals_of,
)
from cluster_est.closed_loop.selection.rounds import (
    ComparedStructure,
    RoundEnd,
    RoundStart,
    SelectionResult,
    SelectionRound,
    compared_structure,
    compared_structures,
    evidence_of_round,
    with_single,
)
from cluster_est.closed_loop.selection.starts import fit_declared, refit_from_other_starts
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from workers.messages import FloatArray

AGAIN = LeastSquares(trials=1, max_iterations=15, ftol=1e-6, xtol=1e-7, differences="forward")


def beam_search(
    workbench: LoopWorkbench,
    base: FittedModel,
    numerical: Callable[[FittedModel], float] = lambda _: 0.0,
    *,
    again: bool = True,
    reached: Callable[[SelectionResult], None] = lambda _: None,
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
    reached
        Called after each round in which something was added, with all that was found so far.
    """
    noise = noise_of(workbench, base.residuals)
    floor = workbench.noise_floor(noise)
    predicted = predict(workbench, base)
    visited = VisitedModels(floor / workbench.size)
    search = _Search(workbench, base, floor, visited, base, predicted)
    while True:
        _say_phase(workbench, search.current)
        screened = screen(workbench, search.current, len(search.steps) + 1)
        begun = search.begin(screened, numerical(search.current))
        end = _round(workbench, begun)
        search.note(end)
        if end.won is None or end.prediction is None:
            if search.replace_by_single():
                continue
            break
        if again and not begun.model.added and _was_local(workbench, base, end.won):
            restart = FitStart(base.problem, _declared_only(end.won), base.added)
            declared = fit_declared(workbench, restart)
            return beam_search(workbench, declared, numerical, again=False, reached=reached)
        if not search.grow(begun, end, end.won, end.prediction):
            break
        search.replace_by_single(whole=True)
        reached(search.result(predicted, noise))
    return search.result(predicted, noise)


@dataclass
class _Search:
    """A beam search under way.

    Attributes
    ----------
    base, floor
        The declared model, fitted, and the sum of squares that the noise alone would leave.
    visited
        The models that it has added effects to.
    current, prediction, rivals, beside
        The accepted structure, its leave-one-out prediction, the rivals of its effects, and the
        structures that it was compared with.
    steps, seen, path
        Of all rounds: what they looked at, the candidates, and the structures that they compared.
    passed
        The structures that were accepted, by the names of their effects.
    first
        The start of the first round.
    singles
        What may take the place of several effects; None where it has not been looked for.
    replaced
        A single effect has taken the place of all that were added before it.
    """

    workbench: LoopWorkbench
    base: FittedModel
    floor: float
    visited: VisitedModels
    current: FittedModel
    prediction: LeaveOneOutPrediction
    rivals: Rivals = field(default_factory=dict)
    beside: tuple[RefittedCandidate, ...] = ()
    steps: list[SelectionRound] = field(default_factory=list)
    seen: list[CandidateEvidence] = field(default_factory=list)
    path: list[ComparedStructure] = field(default_factory=list)
    passed: set[frozenset[str]] = field(default_factory=set)
    first: RoundStart | None = None
    singles: SingleEffects | None = None
    replaced: bool = False

    def begin(self, screened: ScreeningResult, numerical: float) -> RoundStart:
        """Begin a round at the accepted structure."""
        self.visited.keep(self.workbench, self.current, screened.ranking)
        begun = RoundStart(
            self.base,
            self.current,
            self.prediction,
            screened,
            self.visited,
            self.floor,
            self.beside,
            numerical,
        )
        self.first = self.first or begun
        self.passed.add(self.current.structure)
        return begun

    def note(self, end: RoundEnd) -> None:
        """Note what a round has looked at."""
        self.steps.append(end.seen)
        number = len(self.steps)
        self.seen += evidence_of_round(self.workbench, self.current, end, number)
        self.path += compared_structures(self.workbench, self.base, end, self.floor, number)
        if not self.current.added and any(c.candidate.form.free for c in end.compared):
            self.singles = SingleEffects(fine=True)  # they have been tried, and did not pass

    def grow(
        self,
        begun: RoundStart,
        end: RoundEnd,
        won: RefittedCandidate,
        prediction: LeaveOneOutPrediction,
    ) -> bool:
        """Accept what has won a round, revised; False where that leads back to where it was."""
        grown, self.rivals = _revised(self.workbench, begun, end, won, self.rivals)
        if grown is not won.fitted:
            prediction = predict(self.workbench, grown)
        if grown.structure != won.fitted.structure:
            self._add_to_path(grown)
        if grown.structure in self.passed:
            return False
        self.current, self.prediction, self.beside = grown, prediction, end.compared
        return True

    def result(self, predicted: LeaveOneOutPrediction, noise: FloatArray) -> SelectionResult:
        """Return all that was found so far."""
        return SelectionResult(
            self.base, self.current, predicted, self.prediction, self.rivals, tuple(self.steps),
            tuple(self.seen), noise, tuple(self.path),
        )  # fmt: skip

    def replace_by_single(self, *, whole: bool = False) -> bool:
        """Put a single effect in the place of all, if there is a better one; return whether."""
        first = self.first
        if self.replaced or first is None or not may_be_single(self.workbench, first, self.current):
            return False
        self.singles = single_effects(
            self.workbench, first, self.current, self.singles, whole=whole
        )
        single = single_instead(
            self.workbench, first, self.current, self.prediction, self.singles, whole=whole
        )
        if single is None:
            return False
        self.replaced = True
        fall = single.won.criterion - self.base.criterion(self.workbench.records)
        self.seen = with_single(self.seen, single.won, fall)
        self.current, self.prediction = single.won.fitted, single.prediction
        self.rivals, self.beside = single.rivals, ()
        self._add_to_path(self.current)
        return True

    def _add_to_path(self, fitted: FittedModel) -> None:
        row = compared_structure(self.workbench, self.base, fitted, self.floor, len(self.steps))
        self.path.append(row)


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
    """Return what has won a round, refitted and revised, and the rivals of its effects.

    What closes too little for a claim is grown first: other starts and a revision cost as much as a
    round, and the next effect changes what they would find.
    """
    found = rivals_of(won, end.seen.contenders, workbench.thresholds.refinement)
    rivals = {**found, **rivals, **{name: own for name, own in found.items() if own[1]}}
    grown = won.fitted
    if not can_be_claimed(workbench, begun, grown):
        return grown, rivals
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
        curves += refit_named(workbench, begun, curves)
        curved = best_that_passes(workbench, begun, sorted(curves, key=lambda c: c.criterion))
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
