"""Refits of the leading candidates, alone and in pairs, and the models that were refitted.

A score sees only a first small step. Each leading candidate is therefore switched on together with
the step of all parameters that the linear model asks for, simulated, and the best are refitted.

The best pairs of directions are found by linear algebra alone: for two unit directions b, c with
g = b'c and the residual's shares x = b'r, y = c'r, both together carry
(x^2 + y^2 - 2 g x y) / (1 - g^2) of r'r.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.screening.screen import CandidateRanking
from cluster_est.closed_loop.selection.linear_model import (
    NO_BOUND,
    REFINEMENT,
    FirstStep,
    PruningBound,
    can_reach,
    can_reach_with,
    first_steps,
    is_proportional,
    joint_step,
    predicted_criterion,
    shares_left,
    values_at,
)
from cluster_est.closed_loop.settings import LoopPart, LoopSettings, LoopStage
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.statistics.records import StackedRecords

BRIEFLY = 1e-4
"""Relative fall of the sum of squares that ends a refit at most: of two decimals one is enough to
see who is ahead."""

SETTLED_REFIT = 0.1
"""Fall of the criterion that ends a refit to convergence, over what tells two candidates apart."""

FIRST = LeastSquares(trials=1, max_iterations=1, ftol=BRIEFLY, xtol=1e-5, differences="forward")
SHORT = replace(FIRST, max_iterations=2)

WHITE_LEADERS = 8
"""Leaders of the whitened scores that are tried besides those of the plain ones."""
PROMISING = 2
"""Candidates that go on although they are behind, because of what the linear model promises."""
PAIRED, PAIRS_REFITTED = 1000, 8
"""Directions that are paired, for which the work grows with the square; pairs that are refitted."""
ALIKE = 0.98
"""Cosine above which two directions, or two changes of what is predicted, count as one.
Benchmark."""


def full_refit(fitter: Fitter) -> LeastSquares:
    """Return the refit to convergence.

    The criterion of n residuals of one output falls by n times the relative fall of their squares,
    so it ends where that is a part of the smallest difference that tells two candidates apart. An
    output with a small part of all squares may move the criterion by more.
    """
    settled = SETTLED_REFIT * REFINEMENT.equal / max(fitter.size, 1)
    return replace(FIRST, max_iterations=15, ftol=min(BRIEFLY, settled))


def refit_fully(fitter: Fitter, fits: Sequence[FittedModel]) -> list[FittedModel]:
    """Refit to convergence; what cannot be stays as it is."""
    finished = fitter.fit(LoopStage.REFITS, [f.start for f in fits], full_refit(fitter))
    return [new or old for new, old in zip(finished, fits, strict=True)]


@dataclass(frozen=True)
class RefittedCandidate:
    """A structure, refitted: the proposal of a move.

    Attributes
    ----------
    full
        It was refitted to convergence.
    move
        The part of the search that proposed it; None for the move that returns it.
    """

    fitted: FittedModel = field(repr=False)
    criterion: float
    full: bool
    move: LoopPart | None = None

    @property
    def candidate(self) -> EffectCandidate:
        return self.fitted.added[-1]


def best_first(
    records: StackedRecords,
    fits: Sequence[FittedModel],
    move: LoopPart | None = None,
    *,
    full: bool = True,
) -> list[RefittedCandidate]:
    """Return refits with their criteria, the best first."""
    made = [RefittedCandidate(f, f.criterion(records), full, move) for f in fits]
    return sorted(made, key=lambda c: c.criterion)


Rivals = Mapping[str, tuple[RefittedCandidate, list[RefittedCandidate]]]
"""For each effect, by name, the model that brought it in and those that it won against."""


def refit(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    floor: float,
    settings: LoopSettings,
    *,
    further: bool = True,
    bound: PruningBound = NO_BOUND,
) -> list[RefittedCandidate]:
    """Refit the leading candidates; the best first.

    Parameters
    ----------
    current, ranking
        The model that they are added to, and all candidates at it.
    floor
        Sum of squares that the noise alone would leave.
    further
        Go on to candidates further back where the first do not close the gap to it: the larger an
        effect, the less the score of a small one says.
    bound
        What a structure must come down to. What cannot is refitted no further.
    """
    count, trials = settings.refits, settings.trials
    growth = Growth(fitter, current, floor, bound)
    leaders = ranking.leaders(ranking.plain, 2 * trials)
    white = ranking.leaders(ranking.white, WHITE_LEADERS)
    places = list(dict.fromkeys([*leaders[:trials], *white]))
    chosen, left = _mixed(first_steps(fitter, current, ranking, places, bound), count)
    possible = [min(step.sse, step.asked.predicted) for step in chosen]
    near = growth.near_the_best([step.sse for step in chosen], possible)
    contenders = growth.refit_steps([chosen[i] for i in near])
    best = min((c.fitted.sse for c in contenders), default=current.sse)
    if not further or growth.closed_by(best):
        return contenders
    later = [i for i in leaders[trials:] if i not in places]
    left += first_steps(fitter, current, ranking, later, bound)
    left.sort(key=lambda step: step.sse)
    contenders += growth.refit_steps(left[:count])
    return sorted(contenders, key=lambda c: c.criterion)


def _mixed(steps: Sequence[FirstStep], count: int) -> tuple[list[FirstStep], list[FirstStep]]:
    """Two thirds by their rank in the screening, one by the cost of their first step; the rest."""
    ranked = 2 * count // 3
    rest = sorted(steps[ranked:], key=lambda step: step.sse)
    return [*steps[:ranked], *rest[: count - ranked]], rest[count - ranked :]


@final
@dataclass(frozen=True)
class Growth:
    """Refits of what a model may grow to, down to a bound.

    `floor` is the sum of squares that the noise alone would leave.
    """

    fitter: Fitter
    current: FittedModel
    floor: float
    bound: PruningBound

    def refit_steps(self, steps: Sequence[FirstStep]) -> list[RefittedCandidate]:
        """Refit from first steps; the latter half only what may come near the best of the first."""
        ordered = sorted(steps, key=lambda step: step.sse)
        half = (len(ordered) + 1) // 2
        fits = self.briefly([step.start for step in ordered[:half]])
        records, rival = self.fitter.records, self.rival_of_the_best(fits)
        near = [s.start for s in ordered[half:] if s.asked.can_reach(records, self.current, rival)]
        return self.successive_halving([*fits, *self.briefly(near)])

    def briefly(self, starts: Sequence[FitStart]) -> list[FittedModel]:
        """Refit by one iteration; without those that cannot be simulated."""
        return [f for f in self.fitter.fit(LoopStage.REFITS, starts, FIRST) if f is not None]

    def successive_halving(self, fits: Sequence[FittedModel]) -> list[RefittedCandidate]:
        """Refit the better half of brief refits more, and the best to convergence; the best first.

        What has converged waits for the last round. What is far behind where one candidate does it
        all is refitted no further, nor what can neither come near the best so far nor down to what
        it must reach. Some candidates have further to go than others, as where a parameter must
        make room for them: those that the linear model promises to become the best go on too.
        """
        fitter, records = self.fitter, self.fitter.records
        lost: list[FittedModel] = []
        for last in (False, True):
            fits = sorted(fits, key=lambda f: f.criterion(records))
            sums = [f.sse for f in fits]
            rival = self.rival_of_the_best(fits)
            near = [i for i in self.near_the_best(sums, sums) if can_reach(records, fits[i], rival)]
            kept = near[: max(REFINEMENT.finalists, len(fits) // 2)]
            kept += _promising(records, fits, near, kept)
            lost += [f for i, f in enumerate(fits) if i not in kept]
            fits = [fits[i] for i in kept]
            if not last:
                going = [f for f in fits if not f.converged]
                further = iter(fitter.fit(LoopStage.REFITS, [f.start for f in going], SHORT))
                fits = [f if f.converged else next(further) or f for f in fits]
        order = list(range(len(fits)))
        first = order[: REFINEMENT.finalists]
        first += _promising(records, fits, order, first)
        best, rest = [fits[i] for i in first], [fits[i] for i in order if i not in first]
        found = best_first(records, [*lost, *rest], full=False)
        found += best_first(records, refit_fully(fitter, best))
        return sorted(found, key=lambda c: c.criterion)

    def near_the_best(self, reached: Sequence[float], possible: Sequence[float]) -> list[int]:
        """Positions of what may do a part of what the best does, where that closes the gap.

        `reached` and `possible` are the sums of squares of each, as simulated, and at best.
        """
        best = min(reached, default=self.current.sse)
        done = self.current.sse - best
        least = REFINEMENT.behind * done if self.closed_by(best) else -np.inf
        return [i for i, sse in enumerate(possible) if self.current.sse - sse >= least]

    def rival_of_the_best(self, fits: Sequence[FittedModel]) -> PruningBound:
        """What a fit must come down to, to be the best or its rival, where that closes the gap.

        Else none is far behind: what is a part of the truth may do less than what imitates all of
        it.
        """
        records, bound = self.fitter.records, self.bound
        best = min(fits, key=lambda f: f.criterion(records), default=self.current)
        if not bound.pruned or not self.closed_by(best.sse):
            return bound
        rival = best.criterion(records) + REFINEMENT.alternative
        return replace(bound, criterion=min(bound.criterion, rival))

    def closed_by(self, sse: float) -> bool:
        """Return whether a sum of squares closes most of the gap to the noise."""
        return self.current.sse - sse >= REFINEMENT.closes * (self.current.sse - self.floor)


def _promising(
    records: StackedRecords, fits: Sequence[FittedModel], near: Sequence[int], kept: Sequence[int]
) -> list[int]:
    """Positions of some that are not kept, though their next step promises more than the best's."""
    if not kept:
        return []
    best = min(predicted_criterion(records, fits[i]) for i in kept)
    others = [(predicted_criterion(records, fits[i]), i) for i in near if i not in kept]
    better = sorted(each for each in others if each[0] < best)
    return [i for _, i in better[:PROMISING]]


def most_parsimonious(contenders: Sequence[RefittedCandidate]) -> RefittedCandidate:
    """The best contender; among equals the one of plainest name, fewest unknowns, fewest states."""
    best = contenders[0].criterion
    equal = [c for c in contenders if c.full and c.criterion - best < REFINEMENT.equal]
    equal = equal or list(contenders[:1])

    def complexity(c: RefittedCandidate) -> tuple[float, int, int, float]:
        form = c.candidate.form
        return form.order, c.fitted.space.size, len(form.states), c.criterion

    return min(equal, key=complexity)


def rivals_of(
    won: RefittedCandidate,
    contenders: Sequence[RefittedCandidate],
) -> Rivals:
    """For each effect of a structure, those that the data leave possible in its place."""
    best = min((c.criterion for c in contenders), default=won.criterion)
    possible = [c for c in contenders if c.criterion - best <= REFINEMENT.alternative]
    found: dict[str, tuple[RefittedCandidate, list[RefittedCandidate]]] = {}
    for effect in won.fitted.added:
        others = won.fitted.structure - {effect.effect.name}
        own: dict[str, RefittedCandidate] = {}
        for contender in possible:
            instead = sorted(contender.fitted.structure - others)
            if len(instead) == 1 and others < contender.fitted.structure:
                own.setdefault(instead[0], ending_with(contender, instead[0]))
        own.pop(effect.effect.name, None)
        found[effect.effect.name] = (won, list(own.values()))
    return found


def ending_with(contender: RefittedCandidate, name: str) -> RefittedCandidate:
    """The same structure, with one of its effects counted last."""
    added = contender.fitted.added
    if added[-1].effect.name == name:
        return contender
    ordered = sorted(added, key=lambda candidate: candidate.effect.name == name)
    return replace(contender, fitted=replace(contender.fitted, added=tuple(ordered)))


def refit_pairs(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    floor: float,
    bound: PruningBound,
) -> list[RefittedCandidate]:
    """Refit the best pairs; the best first. A contender's last two effects are the pair.

    Those that the linear model does not let hope to be useful are left out.
    """
    asked = [_start_of_pair(fitter, current, ranking, p, bound) for p in best_pairs(ranking)]
    growth = Growth(fitter, current, floor, bound)
    fits = growth.briefly([start for start in asked if start is not None])
    return growth.successive_halving(fits)


def best_pairs(ranking: CandidateRanking, most: int = PAIRS_REFITTED) -> list[tuple[int, int]]:
    """Pairs of trials of different candidates by the share of the residual that they carry.

    Of all pairs at the same two places the best one stands for the others: forms of one argument at
    one site are much alike, and the more of them are tried, the sooner would they crowd out all
    other places. A candidate that carries little alone may carry much beside another.
    """
    scores = ranking.plain
    usable = [
        i for i in np.argsort(-scores.statistics, kind="stable").tolist()
        if scores.df[i] == 1 and not ranking.trials[i].candidate.form.free
    ][:PAIRED]  # fmt: skip
    if len(usable) < 2:
        return []
    first = scores.offsets[usable]
    basis, shares = scores.bases[:, first], scores.coordinates[first]
    gram = basis.T @ basis
    a, b = np.triu_indices(len(usable), 1)
    g = gram[a, b]
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = (shares[a] ** 2 + shares[b] ** 2 - 2.0 * g * shares[a] * shares[b]) / (1 - g**2)
    carried[np.abs(g) > ALIKE] = 0.0
    candidates = [ranking.trials[i].candidate for i in usable]
    places = [(str(c.site), c.effect.variables or (c.form.family,)) for c in candidates]
    found: dict[tuple[tuple[str, tuple[str, ...]], ...], tuple[int, int]] = {}
    for k in np.argsort(-carried, kind="stable").tolist():
        i, j = a[k], b[k]
        if carried[k] > 0.0 and candidates[i].effect.name != candidates[j].effect.name:
            found.setdefault(tuple(sorted((places[i], places[j]))), (usable[i], usable[j]))
        if len(found) >= most:
            break
    return list(found.values())


def _start_of_pair(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    pair: tuple[int, int],
    bound: PruningBound,
) -> FitStart | None:
    """Both effects, with the strengths of the joint linear step; None if of no use."""
    _, strengths, after = joint_step(current, ranking, pair)
    start = current.start
    for m, own in zip(pair, strengths, strict=True):
        trial = ranking.trials[m]
        start = start.plus(trial.candidate, values_at(trial, own))
    if all(is_proportional(ranking.trials[m]) for m in pair):
        added = fitter.space(start).size - len(current.x)
        left = shares_left(ranking.records, current.residuals[ranking.rows], after)
        if not can_reach_with(fitter.records, current, left, added, bound):
            return None
    return start
