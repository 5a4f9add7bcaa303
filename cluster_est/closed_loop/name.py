"""Which of the leading candidates it is: by real simulations and joint refits of all parameters.

A score sees only a first small step. Each leading candidate is therefore switched on together with
the step of all parameters that the linear model asks for, simulated, and the best are refitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.candidates import Candidate
from cluster_est.closed_loop.directions import Trial
from cluster_est.closed_loop.locate import Screening
from cluster_est.closed_loop.workbench import Fitted, Start, Workbench
from cluster_est.methods.least_squares import LeastSquares
from cluster_est.space import Space
from workers.messages import FloatArray

STEPS = (1.0, 0.3)
"""Parts of the linear model's step that are tried."""
LARGEST_STEP = 0.8
"""Of a parameter: in logarithms, or as a share of its value."""
POINTS_OF_GRID = 2
"""Points of a candidate's grid that are tried, the best by score."""
WHITE_LEADERS = 8
HARD = 0.8
"""Below this share of the residual no candidate explains it well, and more are tried."""
EQUAL = 2.0
"""Criteria that differ by less do not tell two candidates apart; the plainer name wins."""
ALTERNATIVE = 10.0
"""Criteria that differ by less leave a candidate possible."""

SHORT = LeastSquares(trials=2, max_iterations=3, ftol=1e-4, xtol=1e-5, differences="forward")
FULL = LeastSquares(trials=2, max_iterations=10, ftol=1e-6, xtol=1e-7, differences="forward")


@dataclass(frozen=True)
class Contender:
    """A model with one effect more, refitted."""

    fitted: Fitted = field(repr=False)
    criterion: float
    full: bool

    @property
    def candidate(self) -> Candidate:
        return self.fitted.added[-1]


def refit(
    bench: Workbench, current: Fitted, screening: Screening, *, wide: bool = True
) -> list[Contender]:
    """Refit the leading candidates; the best first.

    Parameters
    ----------
    current
        The model that they are added to.
    screening
        Of all candidates at that model.
    wide
        Whether to try more of them where none explains the residual well.
    """
    more = 2 if wide and screening.explained < HARD else 1
    leaders = screening.leaders(screening.plain, more * bench.settings.trials)
    leaders += [
        i for i in screening.leaders(screening.white, WHITE_LEADERS)
        if screening.trials[i].candidate.effect.name
        not in {screening.trials[j].candidate.effect.name for j in leaders}
    ]  # fmt: skip
    starts = _try(bench, current, screening, leaders)
    count = bench.settings.refits * (5 if more == 2 else 3) // 3
    chosen = _mixed(starts, count)
    return contest(bench, chosen, max(2, count // 3))


def contest(bench: Workbench, starts: Sequence[Start], finalists: int) -> list[Contender]:
    """Short refits of all, full refits of the best; the best first."""
    fits = [f for f in bench.fit("candidate", starts, SHORT) if f is not None]
    fits.sort(key=lambda f: f.criterion(bench.records))
    best = fits[:finalists]
    again = [f.start for f in best]
    finished = bench.fit("candidate", again, FULL)
    contenders = [
        Contender(new or old, (new or old).criterion(bench.records), True)
        for new, old in zip(finished, best, strict=True)
    ]
    contenders += [Contender(f, f.criterion(bench.records), False) for f in fits[finalists:]]
    return sorted(contenders, key=lambda c: c.criterion)


def plainest(contenders: Sequence[Contender]) -> Contender:
    """The best contender; among equals the plainest name."""
    best = contenders[0].criterion
    equal = [c for c in contenders if c.full and c.criterion - best < EQUAL] or contenders[:1]
    return min(equal, key=lambda c: (c.candidate.form.order, c.criterion))


def alternatives(contenders: Sequence[Contender], chosen: Contender) -> list[Contender]:
    """The contenders that the data leave possible beside the chosen one."""
    return [
        c for c in contenders
        if c is not chosen and c.criterion - contenders[0].criterion <= ALTERNATIVE
    ]  # fmt: skip


def _mixed(starts: Sequence[tuple[float, Start]], count: int) -> list[Start]:
    """Two thirds by their rank in the screening, the rest by the cost of their first step."""
    first = [start for _, start in starts[: 2 * count // 3]]
    rest = sorted(starts[2 * count // 3 :], key=lambda pair: pair[0])
    return first + [start for _, start in rest[: count - len(first)]]


def _try(
    bench: Workbench, current: Fitted, screening: Screening, leaders: Sequence[int]
) -> list[tuple[float, Start]]:
    """Simulate the first step of each leader: its cost, and a start from the best point."""
    asked: list[tuple[Space, FloatArray]] = []
    begun: list[tuple[Trial, Start]] = []
    owners: list[int] = []
    for owner, leader in enumerate(leaders):
        for i in _grid_points(screening, leader):
            trial = screening.trials[i]
            step, strengths = _joint_step(current, screening, i)
            start = current.start.plus(trial.candidate, values_at(trial, strengths))
            space = bench.space(start)
            asked.append((space, _points(current, space, trial, step, strengths)))
            begun.append((trial, start))
            owners.append(owner)
    best: dict[int, tuple[float, Start]] = {}
    for owner, (space, points), (_, start), seen in zip(
        owners, asked, begun, bench.look("trial", asked), strict=True
    ):
        for point, at in zip(points, seen, strict=True):
            if at.ok and (owner not in best or at.cost < best[owner][0]):
                values = space.estimates(point)
                best[owner] = (at.cost, Start(start.problem, values, start.added))
    return [best[owner] for owner in range(len(leaders)) if owner in best]


def _grid_points(screening: Screening, leader: int) -> list[int]:
    """The points of a leader's grid with the best scores."""
    name = screening.trials[leader].candidate.effect.name
    own = [i for i, t in enumerate(screening.trials) if t.candidate.effect.name == name]
    own.sort(key=lambda i: -screening.plain.statistics[i])
    return own[:POINTS_OF_GRID]


def _joint_step(current: Fitted, screening: Screening, i: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step of all unknowns, and the strengths of trial i, on the screened rows."""
    matrix = current.jacobian[screening.rows]
    residuals = current.residuals[screening.rows]
    column = screening.columns[i]
    finite = not screening.trials[i].candidate.strengths
    if finite:  # switched on as it is; the other unknowns make room for it
        joined, target = matrix, -(residuals + column[:, 0])
    else:
        joined, target = np.hstack([matrix, column]), -residuals
    sizes = np.linalg.norm(joined, axis=0)
    sizes[~(sizes > 0.0)] = 1.0
    solved = np.linalg.lstsq(joined / sizes, target, rcond=1e-6)[0] / sizes
    return solved[: matrix.shape[1]], solved[matrix.shape[1] :]


def values_at(trial: Trial, strengths: FloatArray) -> list[float]:
    """The trial's coefficients with the strengths that the linear model asks for."""
    asked = iter(strengths.tolist())
    return [
        next(asked) if c.name in trial.candidate.strengths else value
        for c, value in zip(trial.candidate.form.coefficients, trial.values, strict=True)
    ]


def _points(
    current: Fitted, space: Space, trial: Trial, step: FloatArray, strengths: FloatArray
) -> FloatArray:
    """The first step in several lengths, in the extended space."""
    known = len(current.x)
    log = np.array([u.log for u in current.space.unknowns], bool)
    sizes = np.where(log, 1.0, np.maximum(np.abs(current.x), current.space.typical))
    most = LARGEST_STEP * sizes
    points = []
    for part in STEPS:
        moved = current.x + np.clip(part * step, -most, most)
        point = np.concatenate([moved, space.start[known:]])
        for i, unknown in enumerate(space.unknowns[known:], known):
            if unknown.label.rpartition(".")[2] in trial.candidate.strengths:
                point[i] = part * space.start[i]
        points.append(np.clip(point, space.lower, space.upper))
    return np.array(points)
