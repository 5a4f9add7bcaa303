"""The size of an unknown that starts at 0, from the effect of its changes on the residuals.

Steps, differences and tolerances are relative to the size of an unknown. The size is the magnitude
of the start if that is not 0. Otherwise a size of 1 is as arbitrary as the unit of the parameter,
and so is a part of wide bounds. So trial steps search for the change of the unknown that changes
the residuals by as much as their own norm. This size does not depend on units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.method import Ending, Evaluation, Method, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import FloatArray

MOST_TRIAL_STEPS = 8
"""Largest number of trial steps."""
CLEAR_CHANGE_FACTOR = 100.0
"""Largest ratio, in either direction, of the residuals' change to its target that gives a size."""
FIRST_TRIAL_STEP = 2.0**-50
"""First trial step, relative to the preliminary size; a far longer step may simulate for hours."""
TRIAL_STEP_REDUCTION, TRIAL_STEP_GROWTH = 1e-4, 1e8
"""Factors of a trial step whose simulation fails, and of a trial step without any effect."""
LARGEST_TRIAL_FACTOR = 1e16
"""Largest factor from one trial step to the next."""
LEAST_RESIDUAL_SHARE = 1e-3
"""Lower limit of the norm of the residuals, as a share of the norm of the measured outputs."""
MUCH_SMALLER_SIZE = 1e-2
"""A measured size replaces a size from bounds only if it is smaller than this part of it."""
EVALUATIONS_LEFT_PER_UNKNOWN = 10
"""Evaluations per unknown that the budget must have left for the measurement of sizes."""


def with_sizes(runner: Runner, space: SearchSpace) -> SearchSpace:
    """Return the space with measured sizes of the unknowns that start at 0.

    If a size cannot be measured, the unknown keeps its preliminary size.
    """
    wanted = np.array([u.start == 0.0 and u.size == 0.0 and not u.log for u in space.unknowns])
    if not wanted.any() or runner.evaluations_left < EVALUATIONS_LEFT_PER_UNKNOWN * (
        space.size + 2
    ):
        return space
    (found,) = runner.run([SearchRequest("sizes", _Sizes(tuple(wanted.tolist())), space)])
    if not found.ending.success:
        return space
    bounded = np.isfinite(space.upper - space.lower)
    kept = ~wanted | ~(found.x > 0.0)
    kept |= bounded & (found.x > MUCH_SMALLER_SIZE * space.typical)
    sized = [
        u if keep else replace(u, size=size)
        for u, keep, size in zip(space.unknowns, kept.tolist(), found.x.tolist(), strict=True)
    ]
    return replace(space, unknowns=tuple(sized))


@dataclass(frozen=True)
class _Sizes(Method):
    """A method that measures sizes by trial steps; its solution holds sizes in place of a point.

    Attributes
    ----------
    wanted : (unknowns,)
        True for unknowns whose size is measured; the sizes of the others are 0.
    """

    name: ClassVar[str] = "sizes"
    needs_residuals: ClassVar[bool] = True

    wanted: tuple[bool, ...]

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        x, sizes, open_ = space.start, np.zeros(space.size), np.array(self.wanted)
        (at,) = yield Points(x[None, :], "start")
        targets = _targets(space, at) if at.ok else np.zeros(space.size)
        open_ &= targets > 0.0
        steps = np.where(space.upper > x, FIRST_TRIAL_STEP, -FIRST_TRIAL_STEP) * space.typical
        for _ in range(MOST_TRIAL_STEPS):
            groups = [members[open_[members]] for members in space.colours]
            groups = [members for members in groups if len(members)]
            if not groups:
                break
            points = np.tile(x, (len(groups), 1))
            for point, members in zip(points, groups, strict=True):
                point[members] += steps[members]
            points = np.clip(points, space.lower, space.upper)
            answers = yield Points(points, "size")
            for found, point, members in zip(answers, points, groups, strict=True):
                for i in members.tolist():
                    ratio = _change(space, at, found, i) / float(targets[i])
                    if 1.0 / CLEAR_CHANGE_FACTOR <= ratio <= CLEAR_CHANGE_FACTOR:
                        open_[i] = False
                        # a power of two: a change of units by a power of two changes no bit
                        exponent = np.round(np.log2(abs(float(point[i] - x[i])) / ratio))
                        sizes[i] = float(2.0**exponent)
                    steps[i] *= _factor(ratio)
        return Solution(sizes, at.cost, Ending.CONVERGED if at.ok else Ending.START_FAILED)


def _targets(space: SearchSpace, at: Evaluation) -> FloatArray:
    """Return the norm of the residuals that each unknown acts on, (unknowns,)."""
    left = np.zeros(len(space.experiments))
    for e, (outcome, number) in enumerate(zip(at.outcomes, space.experiments, strict=True)):
        experiment = space.problem.experiments[number]
        measured = [float(np.linalg.norm(o.values / o.sigmas)) for o in experiment.outputs]
        own = 0.0 if outcome.residuals is None else float(np.linalg.norm(outcome.residuals))
        left[e] = max(own, LEAST_RESIDUAL_SHARE * float(np.linalg.norm(measured)))
    return np.asarray(np.sqrt(space.acts_on @ left**2))


def _change(space: SearchSpace, at: Evaluation, found: Evaluation, i: int) -> float:
    """Return the change of the residuals that an unknown acts on; NaN if a simulation failed."""
    squares = 0.0
    for e in np.flatnonzero(space.acts_on[i]).tolist():
        before, after = at.outcomes[e].residuals, found.outcomes[e].residuals
        if before is None or after is None:
            return np.nan
        with np.errstate(over="ignore"):
            squares += float(np.linalg.norm(after - before)) ** 2
    return float(np.sqrt(squares))


def _factor(ratio: float) -> float:
    """Return the factor of the next trial step from the residuals' change over its target."""
    if not np.isfinite(ratio):
        return TRIAL_STEP_REDUCTION
    return (
        float(np.clip(1.0 / ratio, 1.0 / LARGEST_TRIAL_FACTOR, LARGEST_TRIAL_FACTOR))
        if ratio > 0.0
        else TRIAL_STEP_GROWTH
    )
