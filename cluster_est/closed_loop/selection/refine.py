"""Refinement of the leading candidates by real simulations and joint refits of all parameters.

A score sees only a first small step. Each leading candidate is therefore switched on together with
the step of all parameters that the linear model asks for, simulated, and the best are refitted.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.ranking import CandidateRanking
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.statistics.score import ScoreTests
from cluster_est.closed_loop.thresholds import RefinementThresholds
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

FIRST = LeastSquares(trials=2, max_iterations=2, ftol=1e-4, xtol=1e-5, differences="forward")
SHORT = LeastSquares(trials=2, max_iterations=2, ftol=1e-4, xtol=1e-5, differences="forward")
FULL = LeastSquares(trials=2, max_iterations=10, ftol=1e-6, xtol=1e-7, differences="forward")


@dataclass(frozen=True)
class RefittedCandidate:
    """A model with one effect more, refitted."""

    fitted: FittedModel = field(repr=False)
    criterion: float
    full: bool

    @property
    def candidate(self) -> EffectCandidate:
        return self.fitted.added[-1]


Rivals = Mapping[str, tuple[RefittedCandidate, list[RefittedCandidate]]]
"""For each effect, by name, the model that brought it in and those that it won against."""


def refit(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    floor: float,
    *,
    wide: bool = True,
    known: Collection[frozenset[str]] = (),
) -> list[RefittedCandidate]:
    """Refit the leading candidates; the best first.

    Parameters
    ----------
    current
        The model that they are added to.
    ranking
        Of all candidates at that model.
    floor
        Sum of squares that the noise alone would leave.
    wide
        Go on to candidates further back where the first do not close the gap to it: the larger an
        effect, the less the score of a small one says. Without, only half as many are refitted.
    known
        Structures that need no refit, because they were reached from another one.
    """
    thresholds = workbench.thresholds.refinement
    count, trials = workbench.settings.refits, workbench.settings.trials
    if not wide:
        count = (count + 1) // 2
    own = current.structure

    def leading(scores: ScoreTests, most: int) -> list[int]:
        ranked = ranking.leaders(scores, most + len(known))
        names = [ranking.trials[i].candidate.effect.name for i in ranked]
        new = [i for i, name in zip(ranked, names, strict=True) if own | {name} not in known]
        return new[:most]

    leaders = leading(ranking.plain, 2 * trials)
    white = leading(ranking.white, thresholds.white_leaders)
    first = list(dict.fromkeys([*leaders[:trials], *white]))
    starts = first_steps(workbench, current, ranking, first)
    chosen, left = _mixed(starts, count)
    contenders = successive_halving(workbench, chosen)
    if not wide or _closes(current, contenders, floor, thresholds.closes):
        return contenders
    later = [i for i in leaders[trials:] if i not in first]
    left += first_steps(workbench, current, ranking, later)
    left.sort(key=lambda pair: pair[0])
    contenders += successive_halving(workbench, [start for _, start in left[:count]])
    return sorted(contenders, key=lambda c: c.criterion)


def successive_halving(
    workbench: LoopWorkbench, starts: Sequence[FitStart]
) -> list[RefittedCandidate]:
    """Refit all a little, the better half more, and the best to convergence; the best first."""
    lost: list[RefittedCandidate] = []
    finalists = workbench.thresholds.refinement.finalists
    for method in (FIRST, SHORT):
        fits = [f for f in workbench.fit(LoopStage.REFITS, starts, method) if f is not None]
        fits.sort(key=lambda f: f.criterion(workbench.records))
        kept = max(finalists, len(fits) // 2)
        lost += [RefittedCandidate(f, f.criterion(workbench.records), False) for f in fits[kept:]]
        starts = [f.start for f in fits[:kept]]
    best = fits[:kept]
    lost += [RefittedCandidate(f, f.criterion(workbench.records), False) for f in best[finalists:]]
    finished = workbench.fit(LoopStage.REFITS, [f.start for f in best[:finalists]], FULL)
    final = [new or old for new, old in zip(finished, best, strict=False)]
    lost += [RefittedCandidate(f, f.criterion(workbench.records), True) for f in final]
    return sorted(lost, key=lambda c: c.criterion)


def _closes(
    current: FittedModel, contenders: Sequence[RefittedCandidate], floor: float, share: float
) -> bool:
    """Return whether the best contender closes this share of the gap to the noise."""
    if not contenders:
        return False
    best = min(c.fitted.sse for c in contenders)
    return current.sse - best >= share * (current.sse - floor)


def plainest(
    contenders: Sequence[RefittedCandidate], thresholds: RefinementThresholds
) -> RefittedCandidate:
    """The best contender; among equals the plainest name."""
    best = contenders[0].criterion
    equal = [c for c in contenders if c.full and c.criterion - best < thresholds.equal]
    equal = equal or list(contenders[:1])
    return min(equal, key=lambda c: (c.candidate.form.order, c.criterion))


def rivals_of(
    won: RefittedCandidate,
    contenders: Sequence[RefittedCandidate],
    thresholds: RefinementThresholds,
) -> Rivals:
    """For each effect of a structure, those that the data leave possible in its place."""
    best = min((c.criterion for c in contenders), default=won.criterion)
    possible = [c for c in contenders if c.criterion - best <= thresholds.alternative]
    found: dict[str, tuple[RefittedCandidate, list[RefittedCandidate]]] = {}
    for effect in won.fitted.added:
        others = won.fitted.structure - {effect.effect.name}
        own: dict[str, RefittedCandidate] = {}
        for contender in possible:
            instead = sorted(contender.fitted.structure - others)
            if len(instead) == 1 and others < contender.fitted.structure:
                own.setdefault(instead[0], _ending_with(contender, instead[0]))
        own.pop(effect.effect.name, None)
        found[effect.effect.name] = (won, list(own.values()))
    return found


def _ending_with(contender: RefittedCandidate, name: str) -> RefittedCandidate:
    """The same structure, with one of its effects counted last."""
    added = contender.fitted.added
    if added[-1].effect.name == name:
        return contender
    ordered = sorted(added, key=lambda candidate: candidate.effect.name == name)
    return replace(contender, fitted=replace(contender.fitted, added=tuple(ordered)))


def _mixed(
    starts: Sequence[tuple[float, FitStart]], count: int
) -> tuple[list[FitStart], list[tuple[float, FitStart]]]:
    """Two thirds by their rank in the screening, one by the cost of their first step; the rest."""
    ranked = 2 * count // 3
    rest = sorted(starts[ranked:], key=lambda pair: pair[0])
    chosen = [*starts[:ranked], *rest[: count - ranked]]
    return [start for _, start in chosen], rest[count - ranked :]


def first_steps(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    leaders: Sequence[int],
) -> list[tuple[float, FitStart]]:
    """Simulate the first step of each leader: its cost, and a start from the best point."""
    thresholds = workbench.thresholds.refinement
    asked: list[tuple[SearchSpace, FloatArray]] = []
    begun: list[FitStart] = []
    owners: list[int] = []
    for owner, leader in enumerate(leaders):
        for i in _grid_points(ranking, leader)[: thresholds.points_of_grid]:
            trial = ranking.trials[i]
            step, (strengths,) = joint_step(current, ranking, [i])
            start = current.start.plus(trial.candidate, values_at(trial, strengths, thresholds))
            space = workbench.space(start)
            asked.append((space, _points(current, space, trial, step, thresholds)))
            begun.append(start)
            owners.append(owner)
    best: dict[int, tuple[float, FitStart]] = {}
    answers = workbench.evaluate(LoopStage.TRIALS, asked)
    for owner, (space, points), start, seen in zip(owners, asked, begun, answers, strict=True):
        for point, at in zip(points, seen, strict=True):
            if at.ok and (owner not in best or at.cost < best[owner][0]):
                values = space.estimates(point)
                best[owner] = (at.cost, FitStart(start.problem, values, start.added))
    return [best[owner] for owner in range(len(leaders)) if owner in best]


def _grid_points(ranking: CandidateRanking, leader: int) -> list[int]:
    """The points of a leader's grid, the best score first."""
    name = ranking.trials[leader].candidate.effect.name
    own = [i for i, t in enumerate(ranking.trials) if t.candidate.effect.name == name]
    own.sort(key=lambda i: -ranking.plain.statistics[i])
    return own


def joint_step(
    current: FittedModel, ranking: CandidateRanking, trials: Sequence[int]
) -> tuple[FloatArray, list[FloatArray]]:
    """Gauss-Newton step of all unknowns, and how strong each trial is to be, on the screened rows.

    A limit cannot be made stronger or weaker in proportion: it is switched on as it is, the other
    unknowns make room for it, and it has no strengths.
    """
    matrix = current.jacobian[ranking.rows]
    residuals = current.residuals[ranking.rows]
    columns = [ranking.columns[i] for i in trials]
    scaled = [is_proportional(ranking.trials[i]) for i in trials]
    for column, free in zip(columns, scaled, strict=True):
        if not free:
            residuals = residuals + column[:, 0]
    own = [column if free else column[:, :0] for column, free in zip(columns, scaled, strict=True)]
    joined = np.hstack([matrix, *own])
    sizes = np.linalg.norm(joined, axis=0)
    sizes[~(sizes > 0.0)] = 1.0
    solved = np.linalg.lstsq(joined / sizes, -residuals, rcond=1e-6)[0] / sizes
    ends = np.cumsum([matrix.shape[1], *(part.shape[1] for part in own)])
    return solved[: ends[0]], [solved[a:b] for a, b in pairwise(ends)]


def is_proportional(trial: CandidatePoint) -> bool:
    """Return whether its effect grows with a coefficient from nothing."""
    return any(c.neutral == 0.0 for c in trial.candidate.form.coefficients)


def values_at(
    trial: CandidatePoint, strengths: FloatArray, thresholds: RefinementThresholds
) -> list[float]:
    """The trial's coefficients, as strong as the linear model asks for.

    Where an effect is switched on by a finite amount, that amount is scaled, within limits.
    """
    asked = iter(strengths.tolist())
    values = []
    for c, value in zip(trial.candidate.form.coefficients, trial.values, strict=True):
        if c.name in trial.candidate.strengths:
            values.append(next(asked))
        elif c.neutral == 0.0 and strengths.size:
            factor = min(max(next(asked), thresholds.weakest), thresholds.strongest)
            values.append(value * factor)
        else:
            values.append(value)
    return values


def _points(
    current: FittedModel,
    space: SearchSpace,
    trial: CandidatePoint,
    step: FloatArray,
    thresholds: RefinementThresholds,
) -> FloatArray:
    """The first step in several lengths, in the extended space."""
    known = len(current.x)
    log = np.array([u.log for u in current.space.unknowns], bool)
    sizes = np.where(log, 1.0, np.maximum(np.abs(current.x), current.space.typical))
    most = thresholds.largest_step * sizes
    points = []
    for part in thresholds.step_lengths:
        moved = current.x + np.clip(part * step, -most, most)
        point = np.concatenate([moved, space.start[known:]])
        for i, unknown in enumerate(space.unknowns[known:], known):
            if unknown.label.rpartition(".")[2] in trial.candidate.strengths:
                point[i] = part * space.start[i]
        points.append(np.clip(point, space.lower, space.upper))
    return np.array(points)
