"""Predictions of the linear model of the residuals: steps, first steps of candidates, and bounds.

A refit needs many simulations, but its result can be predicted roughly. On the benchmark, the sum
of squares falls by 1.1 times the prediction of the linear model in the median, and by 2.5 times in
one of a hundred cases. Candidates that cannot become useful are pruned by this prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.screen import CandidateRanking
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.problem.search_space import SearchSpace
from cluster_est.statistics.records import StackedRecords
from workers.messages import FloatArray


@dataclass(frozen=True)
class RefinementThresholds:
    """Thresholds of the simulations and refits of leading candidates.

    Attributes
    ----------
    largest_step
        Largest step of a parameter: in logarithms, or as a share of its value. Benchmark.
    closes
        Share of the gap to the noise with which an effect counts as the only one that is missing;
        candidates that are behind it are then not refitted further. Benchmark.
    actual_reduction
        Share of the predicted reduction that a step must bring; otherwise a shorter step is
        tried. Theory: half of it is a good step, J. J. More, doi:10.1007/BFb0067700.
    behind
        If the best candidate closes the gap: share of its improvement that another candidate must
        reach to be refitted further. Benchmark.
    claim_promise, rival_promise
        Factors by which a new effect may lower the sum of squares more than the linear model
        predicts: the first for the test of a claim, the second for the comparison with effects
        found already. Benchmark: 1.1 times in the median, 1.5 times in one of twenty cases.
    linear_promise
        Factor by which the rest of a fit, after some iterations, may lower the criterion more than
        the linear model predicts. Benchmark.
    finalists
        Number of candidates, and of other functions of the best one's argument, that are refitted
        to convergence. Benchmark.
    curves
        Number of free curves that are refitted. Benchmark.
    explains
        Share of the change by the best candidate that another function of its argument must be
        able to explain. Benchmark.
    equal
        Largest difference of the criterion that does not tell two candidates apart. Theory: below 2
        "not worth more than a bare mention", R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90
        (1995) 773-795.
    alternative
        Largest difference of the criterion to the best at which a candidate is still possible.
        Theory: above 10 the evidence is "very strong", ibid.
    """

    largest_step: float = 0.8
    closes: float = 0.9
    actual_reduction: float = 0.5
    behind: float = 0.25
    claim_promise: float = 2.0
    rival_promise: float = 1.5
    linear_promise: float = 3.0
    finalists: int = 3
    curves: int = 2
    explains: float = 0.8
    equal: float = 2.0
    alternative: float = 10.0


REFINEMENT = RefinementThresholds()

STEP_LENGTHS = (1.0, 0.3)
"""Parts of the predicted step that are simulated; the shorter one if the longer one does little."""
POINTS_OF_GRID = 2
"""Number of grid points per candidate whose first step is simulated: those with the best scores."""
SCALED_BY = (0.06, 3.0)
"""Limits of the factor on a finite amount of the grid, for which the linear model may be wrong."""


def gauss_newton_step(jacobian: FloatArray, residuals: FloatArray) -> FloatArray:
    """Return the step of all unknowns that minimises the linear model of the residuals.

    The step is the same in all units, and zero for an unknown without effect.
    """
    sizes = np.linalg.norm(jacobian, axis=0)
    sizes[~(sizes > 0.0)] = 1.0
    step: FloatArray = np.linalg.lstsq(jacobian / sizes, -residuals, rcond=1e-6)[0] / sizes
    return step


def longest_step(space: SearchSpace, x: FloatArray, largest: float) -> FloatArray:
    """Return how far each unknown may move from a point in one step, in search coordinates.

    `largest` is in logarithms, or relative to a parameter's value.
    """
    log = space.logarithmic
    return largest * np.where(log, 1.0, np.maximum(np.abs(x), space.typical))


@dataclass(frozen=True)
class PruningBound:
    """The bound that a refit must reach: largest criterion and largest sum of squares.

    If `pruned`, refits that fall behind the best one of their group also stop.
    """

    criterion: float = np.inf
    sse: float = np.inf
    pruned: bool = True


NO_BOUND = PruningBound()
UNPRUNED = PruningBound(pruned=False)


def predicted_criterion(records: StackedRecords, fitted: FittedModel) -> float:
    """Return the criterion that the linear model predicts after one more step without bounds."""
    return _ahead(fitted).criterion(records)


def can_reach(records: StackedRecords, fitted: FittedModel, bound: PruningBound) -> bool:
    """Return whether more iterations could bring a fit down to a bound.

    The linear model predicts the result of one more step without parameter bounds. After some
    iterations, the rest of a fit brings little more than this step, so a multiple is allowed.
    """
    times, ahead = REFINEMENT.linear_promise, _ahead(fitted)
    criteria = [each.criterion(records) for each in (fitted, ahead)]
    criterion = criteria[0] - times * (criteria[0] - criteria[1])
    sse = fitted.sse - times * (fitted.sse - ahead.sse)
    return bool(criterion <= bound.criterion and sse <= bound.sse)


def can_reach_with(
    records: StackedRecords,
    current: FittedModel,
    shares: FloatArray,
    added: int,
    bound: PruningBound,
) -> bool:
    """Return whether a model with new unknowns could come down to a bound.

    Parameters
    ----------
    current
        The model without the new unknowns.
    shares : (outputs,)
        Share of each output's squares that remains in the linear model after a step of all
        unknowns, including the `added` ones.
    """
    total, likelihood = 0.0, 0.0
    for part, share in zip(records.by_output(current.residuals), shares.tolist(), strict=True):
        if len(part):
            squares = float(np.add.reduce(part**2))
            total += squares * max(1.0 - REFINEMENT.claim_promise * (1.0 - share), 0.0)
            rest = squares * max(1.0 - REFINEMENT.rival_promise * (1.0 - share), 0.0)
            likelihood += len(part) * np.log(max(rest / len(part), 1e-300))
    price = (current.space.size + added) * np.log(len(current.residuals))
    return bool(total <= bound.sse and likelihood + price <= bound.criterion)


def shares_left(records: StackedRecords, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the share (outputs,) of each output's squares that remains in a linear model."""
    left, all_of_it = (_squares(records, each) for each in (after, before))
    return np.array([a / b if b > 0.0 else 1.0 for a, b in zip(left, all_of_it, strict=True)])


def _squares(records: StackedRecords, stacked: FloatArray) -> list[float]:
    return [float(np.add.reduce(part**2)) for part in records.by_output(stacked)]


def _ahead(fitted: FittedModel) -> FittedModel:
    step = gauss_newton_step(fitted.jacobian, fitted.residuals)
    return replace(fitted, residuals=fitted.residuals + fitted.jacobian @ step)


@dataclass(frozen=True)
class AskedStep:
    """A candidate at a grid point, with the step that the linear model proposes.

    `left` is the share of each output's squares that remains in the linear model. `predicted` is
    the sum of squares that remains.
    """

    owner: int
    trial: CandidatePoint
    step: FloatArray = field(repr=False)
    predicted: float
    left: FloatArray = field(repr=False)
    start: FitStart = field(repr=False)
    space: SearchSpace = field(repr=False)

    def can_reach(self, records: StackedRecords, current: FittedModel, bound: PruningBound) -> bool:
        """Return whether it may reach a bound; for finite changes there is no linear model."""
        if not is_proportional(self.trial):
            return True
        added = len(self.space.unknowns) - len(current.x)
        return can_reach_with(records, current, self.left, added, bound)

    def point(self, current: FittedModel, length: float) -> FloatArray:
        """The point after a part of the step, in the extended space of unknowns."""
        known, space = len(current.x), self.space
        most = longest_step(current.space, current.x, REFINEMENT.largest_step)
        moved = current.x + np.clip(length * self.step, -most, most)
        point = np.concatenate([moved, space.start[known:]])
        for i, unknown in enumerate(space.unknowns[known:], known):
            if unknown.parameter.name.rpartition(".")[2] in self.trial.candidate.strengths:
                point[i] = length * space.start[i]
        return np.asarray(np.clip(point, space.lower, space.upper))


@dataclass(frozen=True)
class FirstStep:
    """A candidate at the best of the simulated points along the proposed step."""

    sse: float
    asked: AskedStep = field(repr=False)
    start: FitStart


def first_steps(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    leaders: Sequence[int],
    bound: PruningBound = NO_BOUND,
) -> list[FirstStep]:
    """Simulate the first step of each leader, and shorter steps if it does less than predicted.

    Leaders that cannot be simulated are left out, and so are leaders that cannot become useful
    according to the linear model. If all steps of a leader increase the sum of squares, it starts
    with its effect switched off: a model with one more effect never has to fit worse.
    """
    asked = [
        _asked_step(fitter, current, ranking, owner, i)
        for owner, leader in enumerate(leaders)
        for i in _grid_points(ranking, leader)[:POINTS_OF_GRID]
    ]
    hopeful = {each.owner for each in asked if each.can_reach(fitter.records, current, bound)}
    asked = [each for each in asked if each.owner in hopeful]
    best: dict[int, FirstStep] = {}
    for length in STEP_LENGTHS:
        asked = [each for each in asked if not _does_enough(each, best.get(each.owner), current)]
        points = [(each.space, each.point(current, length)[None]) for each in asked]
        answers = fitter.evaluate(LoopStage.TRIALS, points)
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
    """A leader switched off, if its strength can start at zero; otherwise None."""
    trial = ranking.trials[leader]
    strengths = trial.candidate.strengths
    if not strengths:
        return None
    names = [c.name for c in trial.candidate.form.coefficients]
    off = [0.0 if n in strengths else v for n, v in zip(names, trial.values, strict=True)]
    return current.start.plus(trial.candidate, off)


def _asked_step(
    fitter: Fitter,
    current: FittedModel,
    ranking: CandidateRanking,
    owner: int,
    index: int,
) -> AskedStep:
    trial = ranking.trials[index]
    step, (strengths,), after = joint_step(current, ranking, [index])
    values = values_at(trial, strengths)
    start = current.start.plus(trial.candidate, values)
    left = shares_left(ranking.records, current.residuals[ranking.rows], after)
    squares = _squares(fitter.records, current.residuals)
    predicted = float(sum(share * own for share, own in zip(left, squares, strict=True)))
    return AskedStep(owner, trial, step, predicted, left, start, fitter.space(start))


def _does_enough(asked: AskedStep, longer: FirstStep | None, current: FittedModel) -> bool:
    """Return whether a longer step of a candidate brought enough of the predicted reduction."""
    if longer is None:
        return False
    return current.sse - longer.sse >= REFINEMENT.actual_reduction * (current.sse - asked.predicted)


def _grid_points(ranking: CandidateRanking, leader: int) -> list[int]:
    """The grid points of a leader, the best score first."""
    name = ranking.trials[leader].candidate.effect.name
    own = [i for i, t in enumerate(ranking.trials) if t.candidate.effect.name == name]
    return sorted(own, key=lambda i: -ranking.plain.statistics[i])


def joint_step(
    current: FittedModel, ranking: CandidateRanking, trials: Sequence[int]
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Return the joint Gauss-Newton step, the strengths of each trial, and the residuals left.

    The screened rows are used. A limit cannot change in proportion to a strength. Therefore it is
    switched on completely and has no strengths, and the other unknowns adapt to it. The last result
    is the residuals that remain in the linear model.
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
    """Return whether the effect grows from zero in proportion to a coefficient."""
    return any(c.neutral == 0.0 for c in trial.candidate.form.coefficients)


def values_at(trial: CandidatePoint, strengths: FloatArray) -> list[float]:
    """Return the trial's coefficients, with the strengths that the linear model proposes.

    Some coefficients have one value per experiment. A finite amount is scaled, within limits.
    """
    asked = iter(strengths.tolist())
    values = []
    coefficients = trial.candidate.form.coefficients
    counts = trial.candidate.counts(coefficients)
    for c, value, count in zip(coefficients, trial.values, counts, strict=True):
        if c.name in trial.candidate.strengths:
            values += [next(asked) for _ in range(count)]
        elif c.neutral == 0.0 and strengths.size:
            weakest, strongest = SCALED_BY
            values.append(value * min(max(next(asked), weakest), strongest))
        else:
            values += [value] * count
    return values
