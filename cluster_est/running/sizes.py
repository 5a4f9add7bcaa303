"""The size of an unknown that starts at 0, from what a change of it does to the residuals.

Steps, differences and what counts as nothing are relative to the size of an unknown. That of a
start other than 0 is the start's own. At 0 there is none: 1 is as arbitrary as the unit that the
parameter is given in, and so is a part of wide bounds. So trial steps look for the change of the
unknown that changes the residuals as much as there is left of them, whatever the units.
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
"""Trial steps at most."""
CLEAR_CHANGE_FACTOR = 100.0
"""A change of the residuals within this factor of what is left of them shows the size."""
FIRST_TRIAL_STEP = 2.0**-50
"""First trial step, of the size as it is: one that is far too long may take hours to simulate."""
TRIAL_STEP_REDUCTION, TRIAL_STEP_GROWTH = 1e-4, 1e8
"""Factors of a trial step whose simulation fails, and of one that changes no bit."""
LARGEST_TRIAL_FACTOR = 1e16
"""Largest factor of one trial step."""
LEAST_RESIDUAL_SHARE = 1e-3
"""Share of the measured outputs that the rest of the residuals counts as at least."""
MUCH_SMALLER_SIZE = 1e-2
"""Part of a size from bounds: a measured size takes its place where it is smaller than this
part."""
EVALUATIONS_LEFT_PER_UNKNOWN = 10
"""Evaluations for each unknown that a budget must have left, or sizes stay what they are."""


def with_sizes(runner: Runner, space: SearchSpace) -> SearchSpace:
    """Return the space with sizes for its unknowns that start at 0.

    An unknown whose size cannot be measured keeps what it has.
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
    """Trial steps from the start; its solution holds sizes in place of a point.

    Attributes
    ----------
    wanted : (unknowns,)
        Whose sizes are looked for; those of others are 0.
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
                        # of other units by a power of two it changes no bit
                        exponent = np.round(np.log2(abs(float(point[i] - x[i])) / ratio))
                        sizes[i] = float(2.0**exponent)
                    steps[i] *= _factor(ratio)
        return Solution(sizes, at.cost, Ending.CONVERGED if at.ok else Ending.START_FAILED)


def _targets(space: SearchSpace, at: Evaluation) -> FloatArray:
    """Return (unknowns,): what is left of the residuals that each unknown acts on."""
    left = np.zeros(len(space.experiments))
    for e, (outcome, number) in enumerate(zip(at.outcomes, space.experiments, strict=True)):
        experiment = space.problem.experiments[number]
        measured = [float(np.linalg.norm(o.values / o.sigmas)) for o in experiment.outputs]
        own = 0.0 if outcome.residuals is None else float(np.linalg.norm(outcome.residuals))
        left[e] = max(own, LEAST_RESIDUAL_SHARE * float(np.linalg.norm(measured)))
    return np.asarray(np.sqrt(space.acts_on @ left**2))


def _change(space: SearchSpace, at: Evaluation, found: Evaluation, i: int) -> float:
    """Return the change of the residuals that an unknown acts on; NaN where one failed."""
    squares = 0.0
    for e in np.flatnonzero(space.acts_on[i]).tolist():
        before, after = at.outcomes[e].residuals, found.outcomes[e].residuals
        if before is None or after is None:
            return np.nan
        with np.errstate(over="ignore"):
            squares += float(np.linalg.norm(after - before)) ** 2
    return float(np.sqrt(squares))


def _factor(ratio: float) -> float:
    """Return the factor of the next trial step, after a change of the residuals over its target."""
    if not np.isfinite(ratio):
        return TRIAL_STEP_REDUCTION
    return (
        float(np.clip(1.0 / ratio, 1.0 / LARGEST_TRIAL_FACTOR, LARGEST_TRIAL_FACTOR))
        if ratio > 0.0
        else TRIAL_STEP_GROWTH
    )
