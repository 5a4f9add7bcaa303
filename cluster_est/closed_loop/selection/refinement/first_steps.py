"""First steps: the leading candidates, switched on by the step that the linear model asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.ranking import CandidateRanking
from cluster_est.closed_loop.selection.refinement.linear_step import (
    gauss_newton_step,
    longest_step,
)
from cluster_est.closed_loop.selection.refinement.useful_fit import (
    ANY_FIT,
    UsefulFit,
    may_start_useful,
    shares_left,
)
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.thresholds import RefinementThresholds
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray


@dataclass(frozen=True)
class AskedStep:
    """A candidate at a point of its grid with the step that the linear model asks for.

    `left` is the share of each output's squares that the linear model leaves, `predicted` their
    sum.
    """

    owner: int
    trial: CandidatePoint
    step: FloatArray = field(repr=False)
    predicted: float
    left: FloatArray = field(repr=False)
    start: FitStart = field(repr=False)
    space: SearchSpace = field(repr=False)

    def may_be_useful(
        self, workbench: LoopWorkbench, current: FittedModel, useful: UsefulFit
    ) -> bool:
        """Return whether it may; of what is no small change, the linear model knows nothing."""
        if not is_proportional(self.trial):
            return True
        added = len(self.space.unknowns) - len(current.x)
        return may_start_useful(workbench, current, self.left, added, useful)

    def point(
        self, current: FittedModel, length: float, thresholds: RefinementThresholds
    ) -> FloatArray:
        """The point that a part of the step leads to, in the extended space."""
        known, space = len(current.x), self.space
        most = longest_step(current.space, current.x, thresholds.largest_step)
        moved = current.x + np.clip(length * self.step, -most, most)
        point = np.concatenate([moved, space.start[known:]])
        for i, unknown in enumerate(space.unknowns[known:], known):
            if unknown.label.rpartition(".")[2] in self.trial.candidate.strengths:
                point[i] = length * space.start[i]
        return np.asarray(np.clip(point, space.lower, space.upper))


@dataclass(frozen=True)
class FirstStep:
    """A candidate, switched on by the step that the linear model asks for.

    Attributes
    ----------
    sse
        Sum of squares at the best point that was simulated.
    asked
        The whole step of the linear model.
    start
        From that point.
    """

    sse: float
    asked: AskedStep = field(repr=False)
    start: FitStart


def first_steps(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    leaders: Sequence[int],
    useful: UsefulFit = ANY_FIT,
) -> list[FirstStep]:
    """Simulate the first step of each leader; shorter ones where it does less than predicted.

    Leaders that cannot be simulated are left out, and those that the linear model does not let hope
    to be useful. One whose steps all make it worse starts from
    nothing instead: with one effect more no model need fit worse.
    """
    thresholds = workbench.thresholds.refinement
    asked = [
        _asked_step(workbench, current, ranking, owner, i)
        for owner, leader in enumerate(leaders)
        for i in _grid_points(ranking, leader)[: thresholds.points_of_grid]
    ]
    hopeful = {each.owner for each in asked if each.may_be_useful(workbench, current, useful)}
    asked = [each for each in asked if each.owner in hopeful]
    best: dict[int, FirstStep] = {}
    for length in thresholds.step_lengths:
        asked = [each for each in asked if not _does_enough(each, best, current, thresholds)]
        points = [(each.space, each.point(current, length, thresholds)[None]) for each in asked]
        answers = workbench.evaluate(LoopStage.TRIALS, points)
        for each, (_, (point,)), (at,) in zip(asked, points, answers, strict=True):
            if not at.ok:
                continue
            sse = float(np.add.reduce(at.residuals**2))
            if each.owner not in best or sse < best[each.owner].sse:
                values = each.space.estimates(point)
                start = FitStart(each.start.problem, values, each.start.added)
                best[each.owner] = FirstStep(sse, each, start)
    for owner, step in best.items():
        if step.sse > current.sse and (off := _from_nothing(current, ranking, leaders[owner])):
            best[owner] = FirstStep(current.sse, step.asked, off)
    return [best[owner] for owner in range(len(leaders)) if owner in best]


def _from_nothing(current: FittedModel, ranking: CandidateRanking, leader: int) -> FitStart | None:
    """A leader switched off, where it can be switched on little by little; else None."""
    trial = ranking.trials[leader]
    strengths = trial.candidate.strengths
    if not strengths:
        return None
    names = [c.name for c in trial.candidate.form.coefficients]
    off = [0.0 if n in strengths else v for n, v in zip(names, trial.values, strict=True)]
    return current.start.plus(trial.candidate, off)


def _asked_step(
    workbench: LoopWorkbench,
    current: FittedModel,
    ranking: CandidateRanking,
    owner: int,
    index: int,
) -> AskedStep:
    trial = ranking.trials[index]
    step, (strengths,), after = joint_step(current, ranking, [index])
    values = values_at(trial, strengths, workbench.thresholds.refinement)
    start = current.start.plus(trial.candidate, values)
    left = shares_left(ranking.records, current.residuals[ranking.rows], after)
    sizes = [current.residuals[workbench.records.of_output(o)] for o in range(len(left))]
    predicted = float(
        sum(share * np.add.reduce(r**2) for share, r in zip(left, sizes, strict=True))
    )
    return AskedStep(owner, trial, step, predicted, left, start, workbench.space(start))


def _does_enough(
    asked: AskedStep,
    best: Mapping[int, FirstStep],
    current: FittedModel,
    thresholds: RefinementThresholds,
) -> bool:
    """Return whether its candidate's first step has brought enough of the predicted reduction.

    A longer one was simulated before, or there is nothing to judge by.
    """
    if asked.owner not in best:
        return False
    gained = current.sse - best[asked.owner].sse
    return gained >= thresholds.actual_reduction * (current.sse - asked.predicted)


def _grid_points(ranking: CandidateRanking, leader: int) -> list[int]:
    """The points of a leader's grid, the best score first."""
    name = ranking.trials[leader].candidate.effect.name
    own = [i for i, t in enumerate(ranking.trials) if t.candidate.effect.name == name]
    own.sort(key=lambda i: -ranking.plain.statistics[i])
    return own


def joint_step(
    current: FittedModel, ranking: CandidateRanking, trials: Sequence[int]
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Gauss-Newton step of all unknowns, and how strong each trial is to be, on the screened rows.

    A limit cannot be made stronger or weaker in proportion: it is switched on as it is, the other
    unknowns make room for it, and it has no strengths.

    Returns
    -------
    step
        Of the unknowns.
    strengths
        Of each trial.
    after
        The residuals that the linear model leaves.
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
    solved = gauss_newton_step(joined, residuals)
    after = residuals + joined @ solved
    ends = np.cumsum([matrix.shape[1], *(part.shape[1] for part in own)])
    return solved[: ends[0]], [solved[a:b] for a, b in pairwise(ends)], after


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
