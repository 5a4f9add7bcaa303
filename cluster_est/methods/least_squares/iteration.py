"""One iteration of a least-squares search: from a local model to the next point.

Steps with several damping factors are tried at once. In a curved valley they are corrected to
second order, without further evaluations: a trial x + v yields the curvature of the residuals along
v. The step problem with the residuals r(x + v) - J v in place of r has the solution v + b. The
second-order correction b is half the geodesic acceleration of M. K. Transtrum, J. P. Sethna,
arXiv:1201.5885 (2012). Along the parabola s v + s^2 b a step can be longer than the trial.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.least_squares.linear_map import LocalModel, unknown_sizes
from cluster_est.methods.method import Ending, Evaluation, Points, Progress
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

CORRECTED = 2
"""Largest number of corrected trials: the longest ones that are worse than a shorter trial."""
EXTENSIONS = (2.0, 4.0)
"""Values of s for further points on the parabola of the best trial."""


@dataclass(frozen=True)
class TrialPoints:
    """Trial points from one point, the longest step first.

    Attributes
    ----------
    points, steps : (trials, unknowns)
        Trial points, and their steps.
    dampings : (trials,)
        Damping factors of the steps.
    evaluations
        Evaluations of the points.
    """

    points: FloatArray
    steps: FloatArray
    dampings: FloatArray
    evaluations: list[Evaluation]

    @property
    def costs(self) -> FloatArray:
        """Costs (trials,); infinite if a simulation failed."""
        return np.array([at.cost if at.ok else np.inf for at in self.evaluations])

    @property
    def best(self) -> int:
        """Index of the trial of least cost; the longest step among equal costs."""
        return int(np.argmin(self.costs))

    @property
    def least(self) -> float:
        return float(self.costs[self.best])


def curved_steps(
    model: LocalModel, trials: TrialPoints, before: float
) -> tuple[FloatArray, FloatArray]:
    """Return further steps to try, and their dampings.

    Parameters
    ----------
    model
        Local model around the start of the trials.
    trials
        Evaluated steps.
    before
        Cost of the start of the trials.

    Returns
    -------
    steps, dampings
        At most as many as the trials. A step is left out if the correction is larger than it.
    """
    count, best, costs = len(trials.steps), trials.best, trials.costs
    improved = trials.least < before
    rejected = [i for i in range(best if improved else count) if np.isfinite(costs[i])]
    steps: list[FloatArray] = []
    dampings: list[float] = []
    for i in rejected[:CORRECTED]:
        b = _correction(model, trials, i)
        if model.norm(b) <= model.norm(trials.steps[i]):
            steps.append(trials.steps[i] + b)
            dampings.append(float(trials.dampings[i]))
    if improved:
        v, b = trials.steps[best], _correction(model, trials, best)
        for s in EXTENSIONS:
            if s * model.norm(b) <= model.norm(v):
                steps.append(s * v + s * s * b)
                dampings.append(float(trials.dampings[best]) / s)
    return np.array(steps[:count]), np.array(dampings[:count])


def _correction(model: LocalModel, trials: TrialPoints, i: int) -> FloatArray:
    step = trials.steps[i]
    corrected = model.corrected(step, trials.evaluations[i], float(trials.dampings[i]))
    return np.asarray(corrected - step)


DAMPING_RATIO = 10.0
LEAST_DAMPING, LARGEST_DAMPING = 1e-14, 1e14
REDUCTION_NEAR_MINIMUM = 1e-6
"""Relative reduction by a full step below which a point is close to the minimum."""
NOTICEABLE = 0.04
"""Least significant decrease of the sum of squares, over the variance of the residuals.

It corresponds to a fifth of a standard error of the unknowns."""
SHORTEST_SECANT = 1e-12
"""Smallest square of a part of a step with which derivatives are updated, relative to the square of
the whole step. A shorter part mostly shows the rounding errors of the simulation."""
EXHAUSTED = 1e-12
"""Part of the first cost below which the cost is noise of simulations.

Residuals are then a millionth of the first ones, as with simulated data without noise."""
CURVED_RATIO = 3.0
"""Predicted over actual reduction above which second-order corrections are tried."""


@dataclass(frozen=True)
class IterationState:
    """The state of a search between iterations.

    Attributes
    ----------
    x, at, progress
        The point, its evaluation, and the line of the table.
    largest
        Largest column norms of the Jacobian so far.
    damping
        Damping factor of the next step.
    relative_reduction
        Predicted reduction by a full step at the previous point, over the sum of squares.
    full_step
        The previous point and its full step, if the full step was taken.
    start_cost
        Cost of the start of the search.
    """

    x: FloatArray
    at: Evaluation
    progress: Progress
    largest: FloatArray
    damping: float
    relative_reduction: float = 1.0
    full_step: tuple[FloatArray, FloatArray] | None = None
    start_cost: float = np.inf

    @property
    def exhausted(self) -> bool:
        """Whether the remaining cost is only the noise of simulations."""
        return bool(self.at.cost <= EXHAUSTED * self.start_cost)

    def moved(
        self, space: SearchSpace, x: FloatArray, at: Evaluation, damping: float
    ) -> IterationState:
        """Return the state after an iteration."""
        progress = Progress(
            self.progress.iteration + 1,
            at.cost,
            step=float(np.linalg.norm((x - self.x) / space.typical)),
            damping=damping,
        )
        damping = min(max(damping, LEAST_DAMPING), LARGEST_DAMPING)
        return replace(self, x=x, at=at, progress=progress, damping=damping, full_step=None)


Result = tuple[IterationState, Ending | None]
"""The next state, and the ending if the search ends."""
Steps = Generator[Points, list[Evaluation], Result]


@dataclass(frozen=True)
class LeastSquaresIteration:
    """An iteration, which tries steps from a point until one lowers the cost.

    Attributes
    ----------
    space
        The search space.
    trials
        Number of steps tried at once, each with ten times the damping of the previous step.
    ftol, xtol
        Limits below which a step ends the search.
    """

    space: SearchSpace
    trials: int
    ftol: float
    xtol: float

    def iterate(self, state: IterationState, model: LocalModel) -> Steps:
        """Try steps with increasing damping until one lowers the cost or the damping is too large.

        The search also ends if the longest step is negligible.
        """
        damping = state.damping
        below = min(1, self.trials - 1)  # number of trials with less damping than the state's
        while True:
            dampings = damping * DAMPING_RATIO ** (np.arange(float(self.trials)) - below)
            steps = np.array([model.step(d) for d in dampings])
            short = np.abs(steps[0]) <= self.xtol * unknown_sizes(self.space, state.x)
            least = 1e-3 * self.ftol * model.squares
            if state.damping <= 1.0 and (
                short.all() or model.predicted_reduction(steps[0]) <= least
            ):  # the step is negligible although its damping is small
                return state, _end_of_steps(state, dampings[0])
            trials = yield from self._try(state, "trial", steps, dampings)
            if self._is_curved(state, model, trials):
                steps, steps_dampings = curved_steps(model, trials, state.at.cost)
                if len(steps):
                    curved = yield from self._try(state, "curved", steps, steps_dampings)
                    trials = trials if trials.least <= curved.least else curved
            if trials.least < state.at.cost:
                return self._accept(state, model, trials)
            if not np.isfinite(trials.costs).any():
                along = [s for d in dampings if (s := model.along_walls(d)) is not None]
                if along:
                    trials = yield from self._try(state, "wall", np.array(along), dampings)
                if along and trials.least < state.at.cost:
                    return self._accept(state, model, trials)[0], None
            damping = dampings[-1] * DAMPING_RATIO ** (1 + below)
            if damping > LARGEST_DAMPING:
                return state, _end_of_steps(state, damping)

    def _try(
        self, state: IterationState, purpose: str, steps: FloatArray, dampings: FloatArray
    ) -> Generator[Points, list[Evaluation], TrialPoints]:
        points = np.clip(state.x + steps, self.space.lower, self.space.upper)
        evaluations = yield Points(points, purpose, state.progress)
        return TrialPoints(points, points - state.x, dampings, evaluations)

    def _is_curved(self, state: IterationState, model: LocalModel, trials: TrialPoints) -> bool:
        """Return whether the longest trial's prediction far exceeds the best actual reduction."""
        finite = np.flatnonzero(np.isfinite(trials.costs))
        if not len(finite):
            return False
        predicted = model.predicted_reduction(trials.steps[finite[0]])
        actual = max(state.at.cost - trials.least, 0.0)
        return predicted > max(CURVED_RATIO * actual, self.ftol * model.squares)

    def _accept(self, state: IterationState, model: LocalModel, trials: TrialPoints) -> Result:
        best = trials.best
        x, step, damping = trials.points[best], trials.steps[best], float(trials.dampings[best])
        predicted, actual = model.predicted_reduction(step), state.at.cost - trials.least
        trusted = actual > 0.25 * predicted
        if self.trials == 1 and trusted:
            damping /= DAMPING_RATIO
        small = max(actual, predicted) <= self.ftol * model.squares
        short = np.all(np.abs(step) <= self.xtol * unknown_sizes(self.space, x))
        converged = small or (short and trusted)
        new = state.moved(self.space, x, trials.evaluations[best], damping)
        return new, _end_of_steps(state, trials.dampings[best]) if converged else None


def enough_to_notice(at: Evaluation) -> float:
    """Return the least relative decrease of a cost that is significant with these data."""
    return max(REDUCTION_NEAR_MINIMUM, NOTICEABLE / max(len(at.residuals), 1))


def _end_of_steps(state: IterationState, damping: float) -> Ending:
    """Return the ending if no step is left to try, or the next step is negligible.

    A step that is short because of damping does not prove a minimum. With large damping, the
    search has converged only if the predicted reduction or the cost is negligible. Otherwise the
    derivatives are wrong, for example because simulations are noisy.
    """
    enough = enough_to_notice(state.at)
    close = damping <= 1.0 or state.relative_reduction <= enough or state.exhausted
    return Ending.CONVERGED if close else Ending.STALLED
