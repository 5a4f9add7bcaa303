"""One iteration of a least-squares search: from a local model to the next point."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Points, Progress
from cluster_est.methods.least_squares.curved_steps import TriedPoints, curved_steps
from cluster_est.methods.least_squares.local_model import LocalModel, sizes
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

DAMPING_RATIO = 10.0
LEAST_DAMPING, LARGEST_DAMPING = 1e-14, 1e14
PROMISED = 3.0
"""How many times the gain of the best trial the model must promise before steps are bent."""


@dataclass(frozen=True)
class IterationState:
    """Where a search stands.

    Attributes
    ----------
    x, at, progress
        The point, its evaluation, and the line of the table.
    largest
        Largest column norms of the Jacobian so far.
    damping
        With which the next steps begin.
    offset
        What a full step promised at the point before, over the sum of squares.
    full_step
        The point before and its full step, if that was taken.
    """

    x: FloatArray
    at: Evaluation
    progress: Progress
    largest: FloatArray
    damping: float
    offset: float = 1.0
    full_step: tuple[FloatArray, FloatArray] | None = None

    def moved(
        self, space: SearchSpace, x: FloatArray, at: Evaluation, damping: float
    ) -> IterationState:
        """One iteration further."""
        progress = Progress(
            self.progress.iteration + 1,
            at.cost,
            step=float(np.linalg.norm((x - self.x) / space.typical)),
            damping=damping,
        )
        damping = min(max(damping, LEAST_DAMPING), LARGEST_DAMPING)
        return replace(self, x=x, at=at, progress=progress, damping=damping, full_step=None)


Result = tuple[IterationState, Ending | None]
"""The next state, and why to stop there if so."""
Steps = Generator[Points, list[Evaluation], Result]


@dataclass(frozen=True)
class LeastSquaresIteration:
    """Tries steps from a point until one lowers the cost.

    Attributes
    ----------
    space
        What is searched.
    trials
        Steps tried at once, each with ten times the damping of the one before.
    ftol, xtol
        When a step is too small to go on.
    """

    space: SearchSpace
    trials: int
    ftol: float
    xtol: float

    def iterate(self, state: IterationState, model: LocalModel) -> Steps:
        """Try steps, with ever more damping, until one lowers the cost or none ever will."""
        damping = state.damping
        bolder = min(1, self.trials - 1)
        while True:
            dampings = damping * DAMPING_RATIO ** (np.arange(float(self.trials)) - bolder)
            steps = np.array([model.step(d) for d in dampings])
            if self._negligible(state, model, steps[0]):
                return state, Ending.CONVERGED
            trials = yield from self._try(state, "trial", steps, dampings)
            if self._bends(state, model, trials):
                curved, softer = curved_steps(model, trials, state.at.cost)
                if len(curved):
                    more = yield from self._try(state, "curved", curved, softer)
                    trials = trials if trials.least <= more.least else more
            if trials.least < state.at.cost:
                return self._accept(state, model, trials)
            damping = dampings[-1] * DAMPING_RATIO ** (1 + bolder)
            if damping > LARGEST_DAMPING:
                return state, Ending.STALLED

    def _try(
        self, state: IterationState, purpose: str, steps: FloatArray, dampings: FloatArray
    ) -> Generator[Points, list[Evaluation], TriedPoints]:
        points = np.clip(state.x + steps, self.space.lower, self.space.upper)
        evaluations = yield Points(points, purpose, state.progress)
        return TriedPoints(points, points - state.x, dampings, evaluations)

    def _bends(self, state: IterationState, model: LocalModel, trials: TriedPoints) -> bool:
        """Whether the boldest trial promised much more than the best one gained."""
        usable = np.flatnonzero(np.isfinite(trials.costs))
        if not len(usable):
            return False
        promised = model.gain(trials.steps[usable[0]])
        gained = max(state.at.cost - trials.least, 0.0)
        return promised > max(PROMISED * gained, self.ftol * model.squares)

    def _accept(self, state: IterationState, model: LocalModel, trials: TriedPoints) -> Result:
        best = trials.best
        x, step, damping = trials.points[best], trials.steps[best], float(trials.dampings[best])
        expected, gained = model.gain(step), state.at.cost - trials.least
        trusted = gained > 0.25 * expected
        if self.trials == 1 and trusted:
            damping /= DAMPING_RATIO
        small = max(gained, expected) <= self.ftol * model.squares
        short = np.all(np.abs(step) <= self.xtol * sizes(self.space, x))
        converged = small or (short and trusted)
        new = state.moved(self.space, x, trials.evaluations[best], damping)
        return new, Ending.CONVERGED if converged else None

    def _negligible(self, state: IterationState, model: LocalModel, step: FloatArray) -> bool:
        """Whether even the boldest step would change or gain nothing."""
        bold = state.damping <= 1.0
        return bold and (
            bool(np.all(np.abs(step) <= self.xtol * sizes(self.space, state.x)))
            or model.gain(step) <= 1e-3 * self.ftol * model.squares
        )
