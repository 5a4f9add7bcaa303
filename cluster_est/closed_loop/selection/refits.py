"""Refits of the leading candidates, single and in pairs, and the refitted models.

A score describes only a small first step. Therefore each leading candidate is switched on, together
with the step of all parameters from the linear model, and simulated. The best are refitted.

The best pairs of directions are found by linear algebra alone. For two unit directions b and c with
g = b'c, and the shares x = b'r and y = c'r of the residual r, both together explain
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
"""Largest relative fall of the sum of squares at which a refit ends: precise enough to see which
candidate is ahead."""

SETTLED_REFIT = 0.1
"""Fall of the criterion at which a full refit ends, relative to `REFINEMENT.equal`."""

FIRST = LeastSquares(trials=1, max_iterations=1, ftol=BRIEFLY, xtol=1e-5, differences="forward")
SHORT = replace(FIRST, max_iterations=2)

WHITE_LEADERS = 8
"""Number of leaders by whitened scores that are tried in addition to those by plain scores."""
PROMISING = 2
"""Number of candidates that continue although they are behind, because of their predicted steps."""
PAIRED, PAIRS_REFITTED = 1000, 8
"""Number of directions that are paired (the work grows with its square), and of refitted pairs."""
ALIKE = 0.98
"""Cosine above which two directions, or two changes of the prediction, count as the same.
Benchmark."""


def full_refit(fitter: Fitter) -> LeastSquares:
    """Return the least-squares method of a refit to convergence.

    For n residuals of one output, the criterion falls by n times the relative fall of their sum of
    squares. The refit ends when this is a small part of the smallest difference that tells two
    candidates apart. An output with a small part of the squares may change the criterion by more.
    """
    settled = SETTLED_REFIT * REFINEMENT.equal / max(fitter.size, 1)
    return replace(FIRST, max_iterations=15, ftol=min(BRIEFLY, settled))


def refit_fully(fitter: Fitter, fits: Sequence[FittedModel]) -> list[FittedModel]:
    """Refit models to convergence; a model whose refit fails is returned unchanged."""
    finished = fitter.fit(LoopStage.REFITS, [f.start for f in fits], full_refit(fitter))
    return [new or old for new, old in zip(finished, fits, strict=True)]


@dataclass(frozen=True)
class RefittedCandidate:
    """A refitted structure: the proposal of a move.

    Attributes
    ----------
    full
        Whether it was refitted to convergence.
    move
        The part of the search that proposed it; None means the move that returned it.
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
    """Return refitted models with their criteria; the best comes first."""
    made = [RefittedCandidate(f, f.criterion(records), full, move) for f in fits]
    return sorted(made, key=lambda c: c.criterion)


Rivals = Mapping[str, tuple[RefittedCandidate, list[RefittedCandidate]]]
"""By effect name: the model that introduced the effect, and the rivals that it was better than."""


def refit(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    floor: float,
    settings: LoopSettings,
    bound: PruningBound = NO_BOUND,
) -> list[RefittedCandidate]:
    """Refit the leading candidates; the best comes first.

    Parameters
    ----------
    current, ranking
        The model to which candidates are added, and the ranking of all candidates at this model.
    floor
        Sum of squares that noise alone would leave.
    bound
        Criterion and sum of squares that a structure must reach; others are not refitted further.
    """
    growth = Growth(fitter, current, floor, bound)
    leaders = ranking.leaders(ranking.plain, settings.trials)
    whitened = LoopPart.WHITE_LEADERS not in settings.without
    white = ranking.leaders(ranking.white, WHITE_LEADERS) if whitened else []
    places = list(dict.fromkeys([*leaders, *white]))
    chosen = _mixed(first_steps(fitter, current, ranking, places, bound), settings.refits)
    possible = [min(step.sse, step.asked.predicted) for step in chosen]
    near = growth.near_the_best([step.sse for step in chosen], possible)
    return growth.refit_steps([chosen[i] for i in near])


def _mixed(steps: Sequence[FirstStep], count: int) -> list[FirstStep]:
    """Choose steps: two thirds by rank, and one third of the others by their sum of squares."""
    ranked = 2 * count // 3
    rest = sorted(steps[ranked:], key=lambda step: step.sse)
    return [*steps[:ranked], *rest[: count - ranked]]


@final
@dataclass(frozen=True)
class Growth:
    """Refits of the structures that a model may be extended to, with a bound for pruning.

    `floor` is the sum of squares that the noise alone would leave.
    """

    fitter: Fitter
    current: FittedModel
    floor: float
    bound: PruningBound

    def refit_steps(self, steps: Sequence[FirstStep]) -> list[RefittedCandidate]:
        """Refit from first steps; the second half only if they may come near the best so far."""
        ordered = sorted(steps, key=lambda step: step.sse)
        half = (len(ordered) + 1) // 2
        fits = self.briefly([step.start for step in ordered[:half]])
        records, rival = self.fitter.records, self.rival_of_the_best(fits)
        near = [s.start for s in ordered[half:] if s.asked.can_reach(records, self.current, rival)]
        return self.successive_halving([*fits, *self.briefly(near)])

    def briefly(self, starts: Sequence[FitStart]) -> list[FittedModel]:
        """Refit by one iteration; models that cannot be simulated are left out."""
        return [f for f in self.fitter.fit(LoopStage.REFITS, starts, FIRST) if f is not None]

    def successive_halving(self, fits: Sequence[FittedModel]) -> list[RefittedCandidate]:
        """Refit the better half further and the best to convergence; the best comes first.

        Converged models wait for the last round. A model is not refitted further if it is far
        behind one that closes the gap alone, or if it can reach neither the best so far nor the
        bound. Some models need more iterations than others, for example if a parameter must first
        change. So models whose predicted criterion is better than that of the best also continue.
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
        """Positions of models that may do a given part of what the best one does.

        If the best one does not close the gap, these are all positions. `reached` and `possible`
        are the sums of squares of each model: as simulated, and the lowest that is possible.
        """
        best = min(reached, default=self.current.sse)
        done = self.current.sse - best
        least = REFINEMENT.behind * done if self.closed_by(best) else -np.inf
        return [i for i, sse in enumerate(possible) if self.current.sse - sse >= least]

    def rival_of_the_best(self, fits: Sequence[FittedModel]) -> PruningBound:
        """Return the bound that a fit must reach to become the best or its rival.

        The bound is stricter only if the best fit closes the gap. Otherwise a part of the true
        structure may do less than a single effect that imitates the whole.
        """
        records, bound = self.fitter.records, self.bound
        best = min(fits, key=lambda f: f.criterion(records), default=self.current)
        if not bound.pruned or not self.closed_by(best.sse):
            return bound
        rival = best.criterion(records) + REFINEMENT.alternative
        return replace(bound, criterion=min(bound.criterion, rival))

    def closed_by(self, sse: float) -> bool:
        """Return whether a sum of squares closes most of the gap to the noise floor."""
        return self.current.sse - sse >= REFINEMENT.closes * (self.current.sse - self.floor)


def _promising(
    records: StackedRecords, fits: Sequence[FittedModel], near: Sequence[int], kept: Sequence[int]
) -> list[int]:
    """Positions of pruned models with a better predicted criterion than the kept ones."""
    if not kept:
        return []
    best = min(predicted_criterion(records, fits[i]) for i in kept)
    others = [(predicted_criterion(records, fits[i]), i) for i in near if i not in kept]
    better = sorted(each for each in others if each[0] < best)
    return [i for _, i in better[:PROMISING]]


def most_parsimonious(contenders: Sequence[RefittedCandidate]) -> RefittedCandidate:
    """The best contender; among equals, the one with the simplest form and fewest unknowns."""
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
    """For each effect of a structure, the rivals that the data do not rule out in its place."""
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
    """The same structure, with the named effect moved to the last position."""
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
    """Refit the best pairs; the best comes first. The pair is the last two effects of a contender.

    Pairs that cannot become useful according to the linear model are left out.
    """
    asked = [_start_of_pair(fitter, current, ranking, p, bound) for p in best_pairs(ranking)]
    growth = Growth(fitter, current, floor, bound)
    fits = growth.briefly([start for start in asked if start is not None])
    return growth.successive_halving(fits)


def best_pairs(ranking: CandidateRanking, most: int = PAIRS_REFITTED) -> list[tuple[int, int]]:
    """Pairs of trials of different candidates, sorted by the share of the residual they explain.

    At each two places, only the best pair is used. Forms of one argument at one site are similar,
    so with many forms tried, their pairs would displace all other places. A candidate that explains
    little alone may explain much together with another.
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
    """Start with both effects, at the strengths of the joint linear step; None if not useful."""
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
