"""A bounded Levenberg-Marquardt method that asks for as much as it can at once.

An iteration is two requests: one point for each colour of unknowns (the Jacobian), then steps for
several damping factors at the same time, of which the best is taken. The number of trial steps is
an option and never the number of workers, so the result does not depend on the machine.

Each step minimises the linear model within the bounds exactly, so a bound that becomes active does
not bend the step of the other unknowns. Damping is scaled by the largest column norms seen, which
makes the iterates independent of the units of the unknowns.

References: D. W. Marquardt, J. SIAM 11 (1963) 431-441, doi:10.1137/0111030; J. J. More, The
Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978), doi:10.1007/BFb0067700.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np

from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.methods.bounded_step import StepSolver
from cluster_est.methods.differences import Jacobian, Scheme, jacobian
from cluster_est.space import Space
from workers.messages import FloatArray

DAMPING_RATIO = 10.0
LEAST_DAMPING, LARGEST_DAMPING = 1e-14, 1e14


@dataclass(frozen=True)
class LeastSquares(Method):
    """Levenberg-Marquardt with coloured differences and parallel trial steps.

    The method to try first for any sum of squares: few evaluations, and each request keeps many
    workers busy. It finds the minimum that the start leads to; for others use several starts.

    Attributes
    ----------
    trials
        Steps that are tried at once, each with ten times the damping of the one before.
    max_iterations
        Limit on the number of Jacobians.
    ftol, xtol, gtol
        Converged when the model expects to lower the cost by less than `ftol` of it, when a step is
        shorter than `xtol` of the point, or when the cosine between the residuals and every column
        of the Jacobian that is not held by a bound is below `gtol`.
    differences
        "forward", "central", or "auto": forward until converged, then central to the end, which
        removes the error that forward differences leave in the minimum.
    relative_step
        Relative step of the differences; 0 takes the one that suits the solver's noise.
    """

    name: ClassVar[str] = "least_squares"
    needs_residuals: ClassVar[bool] = True

    trials: int = field(default=4, metadata={"least": 1})
    max_iterations: int = field(default=100, metadata={"least": 1})
    ftol: float = field(default=1e-10, metadata={"least": 0.0})
    xtol: float = field(default=1e-10, metadata={"least": 0.0})
    gtol: float = field(default=1e-10, metadata={"least": 0.0})
    differences: Literal["auto", "forward", "central"] = "auto"
    relative_step: float = field(default=0.0, metadata={"least": 0.0})

    def search(self, space: Space, generator: np.random.Generator) -> Search:
        x = space.start
        (at,) = yield Points(x[None, :], "start", Progress(0, np.nan))
        if not at.ok:
            return Solution(x, np.nan, Ending.START_FAILED, at.reason)
        state = _State(x, at, Progress(0, at.cost), np.zeros(space.size), damping=1e-3)
        scheme: Scheme = "central" if self.differences == "central" else "forward"
        while True:
            derivatives = yield from jacobian(
                space, state.x, state.at, scheme, self.relative_step, state.progress
            )
            state, ending = yield from self._iterate(space, state, derivatives)
            if ending is None:
                continue
            refine = self.differences == "auto" and scheme == "forward"
            if refine and ending in (Ending.CONVERGED, Ending.STALLED):
                scheme = "central"
                state = replace(state, damping=min(state.damping, 1e-3))
                continue
            return Solution(
                x=state.x,
                cost=state.at.cost,
                ending=ending,
                iterations=state.progress.iteration,
                jacobian=derivatives.matrix,
                difference_steps=derivatives.steps,
                at=state.at,
            )

    def _iterate(
        self, space: Space, state: _State, derivatives: Jacobian
    ) -> Generator[Points, list[Evaluation], tuple[_State, Ending | None]]:
        """From a Jacobian to the next point. Returns the new state, and why to stop if so."""
        matrix, residuals = derivatives.matrix, state.at.residuals
        if derivatives.frozen.all():
            return state, Ending.DERIVATIVES_FAILED
        if state.at.cost == 0.0:
            return state, Ending.PERFECT
        optimality = _optimality(space, state.x, matrix, residuals)
        scale = np.maximum(state.scale, np.linalg.norm(matrix, axis=0))
        progress = replace(state.progress, optimality=optimality, damping=state.damping)
        state = replace(state, scale=scale, progress=progress)
        if optimality <= self.gtol:
            return state, Ending.CONVERGED
        if state.progress.iteration >= self.max_iterations:
            return state, Ending.MAX_ITERATIONS
        weights = np.where(scale > 0.0, scale, 1.0)
        solver = StepSolver(
            matrix, residuals, weights, space.lower - state.x, space.upper - state.x
        )
        return (yield from self._step(space, state, solver))

    def _step(
        self, space: Space, state: _State, solver: StepSolver
    ) -> Generator[Points, list[Evaluation], tuple[_State, Ending | None]]:
        """Try steps, with ever more damping, until one lowers the cost or none ever will."""
        damping = state.damping
        bolder = min(1, self.trials - 1)
        while True:
            dampings = damping * DAMPING_RATIO ** (np.arange(float(self.trials)) - bolder)
            steps = [solver.step(d) for d in dampings]
            points = np.clip(state.x + steps, space.lower, space.upper)
            if self._negligible(space, state, solver, steps[0]):
                return state, Ending.CONVERGED
            tried = yield Points(points, "trial", state.progress)
            best = _best(tried)
            if best is not None and tried[best].cost < state.at.cost:
                return self._accept(space, state, solver, points[best], tried[best], dampings[best])
            damping = dampings[-1] * DAMPING_RATIO ** (1 + bolder)
            if damping > LARGEST_DAMPING:
                return state, Ending.STALLED

    def _accept(
        self,
        space: Space,
        state: _State,
        solver: StepSolver,
        x: FloatArray,
        at: Evaluation,
        damping: float,
    ) -> tuple[_State, Ending | None]:
        step = x - state.x
        expected = state.at.cost - solver.predicted_cost(step)
        gained = state.at.cost - at.cost
        trusted = gained > 0.25 * expected
        if self.trials == 1 and trusted:
            damping /= DAMPING_RATIO
        progress = Progress(
            state.progress.iteration + 1,
            at.cost,
            step=float(np.linalg.norm(step / space.typical)),
            damping=damping,
        )
        damping = min(max(damping, LEAST_DAMPING), LARGEST_DAMPING)
        new = _State(x, at, progress, state.scale, damping)
        small = max(gained, expected) <= self.ftol * state.at.cost
        short = np.all(np.abs(step) <= self.xtol * np.maximum(np.abs(x), space.typical))
        return new, Ending.CONVERGED if small or (short and trusted) else None

    def _negligible(
        self, space: Space, state: _State, solver: StepSolver, step: FloatArray
    ) -> bool:
        """Whether even the boldest step would change or gain nothing."""
        gain = state.at.cost - solver.predicted_cost(step)
        size = np.maximum(np.abs(state.x), space.typical)
        bold = state.damping <= 1.0
        return bold and (
            bool(np.all(np.abs(step) <= self.xtol * size))
            or gain <= 1e-3 * self.ftol * state.at.cost
        )


@dataclass(frozen=True)
class _State:
    """Where the iteration stands: the point, its evaluation, the scale and damping of the next."""

    x: FloatArray
    at: Evaluation
    progress: Progress
    scale: FloatArray
    damping: float


def _best(tried: list[Evaluation]) -> int | None:
    """The trial of lowest cost, the boldest of equals."""
    ok = [i for i, evaluation in enumerate(tried) if evaluation.ok]
    return min(ok, key=lambda i: tried[i].cost) if ok else None


def _optimality(space: Space, x: FloatArray, matrix: FloatArray, residuals: FloatArray) -> float:
    """Largest cosine between residuals and a column whose unknown can still move downhill."""
    gradient = matrix.T @ residuals
    norms = np.linalg.norm(matrix, axis=0) * np.linalg.norm(residuals)
    blocked = ((x <= space.lower) & (gradient > 0.0)) | ((x >= space.upper) & (gradient < 0.0))
    usable = ~blocked & (norms > 0.0)
    return float(np.max(np.abs(gradient[usable]) / norms[usable], initial=0.0))
