"""Sequential quadratic programming with a trust region, made for few and costly simulations.

An iteration is two requests: the points of the derivatives, then one trial step. The step minimises
a quadratic model of the cost plus a penalty on the violation of the linearised constraints, within
the bounds and a trust region (R. Fletcher, Practical Methods of Optimization, 2nd ed. (1987),
section 14.4). A rejected step costs one point, not new derivatives.

    merit          cost + penalty * violations: what a step must lower (penalty.py)
    surroundings   the model at the current point, and its best step (surroundings.py)
    curvature      of a sum of squares comes with its Jacobian (curvature.py)
    correction     of a step that bent constraints spoil: their values at its end are used
    kink           of a constraint: its derivatives at the end of a spoiled step are asked for, and
                   both of its faces count from then on (linear_pieces.py)
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.methods.callback_bridge import drive
from cluster_est.methods.derivatives.differences import Differences
from cluster_est.methods.derivatives.gradients import CostDerivatives, derivatives
from cluster_est.methods.derivatives.sensitivities import JacobianProvider
from cluster_est.methods.sqp.evaluation_cache import usable, why_unusable, worst_constraint
from cluster_est.methods.sqp.hessian import Hessian
from cluster_est.methods.sqp.local_model import ModelStep, SqpLocalModel
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

FIRST_RADIUS = 1.0
"""In units of each unknown's size."""
REFINED_RADIUS = 1e-2
"""The least one that central differences begin with."""
ACCEPTED, POOR, GOOD = 0.05, 0.25, 0.75
"""Of what a step promised: the least that is taken, and what shrinks and widens the region."""
SHRINK, WIDEN = 0.25, 3.0
FLOOR = 1e-16
"""A cost this much smaller than the largest seen counts as zero."""
NEARLY_OPTIMAL = 1e-3
AT_A_KINK = (
    "no step longer than xtol lowers the cost; the gradient is not zero there, as at a kink or "
    "where simulations are noisy"
)

Asking = Generator[Points, list[Evaluation], CostDerivatives]


@dataclass(frozen=True)
class SqpOptions:
    """Options of the search; see `Sqp`."""

    max_iterations: int = 100
    ftol: float = 1e-10
    xtol: float = 1e-6
    differences: Differences = "auto"
    relative_step: float = 0.0
    hessian: Hessian = "auto"
    speculative_gradient: bool = False


def sequential_search(space: SearchSpace, settings: SqpOptions) -> Search:
    """Minimise the cost of `space` under its bounds and constraints.

    The solution has the Jacobian of the residuals where the cost gives them weights.
    """
    x = space.start
    (at,) = yield Points(x[None, :], "start", Progress(0, np.nan))
    if not usable(at):
        return Solution(x, np.nan, Ending.START_FAILED, why_unusable(at))
    search = _TrustRegionSearch(space, settings, x, at)
    ending: Ending | None = None
    while ending is None:
        ending = yield from search.iterate()
        if ending is not None and search.refine(ending):
            ending = None
    return (yield from search.solution(ending))


@dataclass(frozen=True)
class _TrialStep:
    """A step, and what came of it: the point at its end, and by how much that lowered the merit."""

    step: ModelStep
    x: FloatArray
    at: Evaluation
    gained: float

    @property
    def ratio(self) -> float:
        """What came of what was promised."""
        return self.gained / self.step.promised if self.step.promised > 0.0 else -1.0


class _TrustRegionSearch:
    """State of one search: the current point, what is known around it, and the trust region."""

    def __init__(
        self, space: SearchSpace, settings: SqpOptions, x: FloatArray, at: Evaluation
    ) -> None:
        self._space, self._settings = space, settings
        weighted = space.problem.cost.weights(at.residuals, space.outputs) is not None
        differences = (
            settings.differences if weighted or settings.differences != "sensitivities" else "auto"
        )
        self._slopes = JacobianProvider(space, differences, settings.relative_step)
        self._feasibility_only = at.residuals.size == 0
        self._around = SqpLocalModel(space, settings.hessian, self._feasibility_only)
        self._penalty = self._around.penalty
        self._x, self._at, self._best = x, at, (x, at)
        self._multipliers = np.zeros(len(space.constraint_names))
        self._radius, self._largest = FIRST_RADIUS, abs(at.cost)
        self._ahead: tuple[FloatArray, list[Evaluation]] | None = None
        self._progress = Progress(0, at.cost, violation=self._shown(at))

    def iterate(self) -> Generator[Points, list[Evaluation], Ending | None]:
        """From derivatives to the next point. Returns why to stop, if so."""
        if self._found():
            return Ending.CONVERGED
        yield from self._differentiate(self._x, self._at)
        if self._around.slopes.frozen.all():
            return Ending.DERIVATIVES_FAILED
        ending = self._judge()
        return (yield from self._advance()) if ending is None else ending

    def refine(self, ending: Ending) -> bool:
        """Switch to central differences where forward ones are through; whether that was done."""
        through = ending is Ending.CONVERGED or (
            ending is Ending.STALLED and self._progress.optimality < NEARLY_OPTIMAL
        )
        if not through or self._found() or not self._slopes.refine():
            return False
        self._ahead = None
        self._radius = max(self._radius, REFINED_RADIUS)
        return True

    def solution(self, ending: Ending) -> Search:
        """The point of least merit among the feasible ones, else the one of least violation."""
        x, at = self._best
        if self._at.feasible and self._penalty.merit(self._at) <= self._penalty.merit(at):
            x, at = self._x, self._at
        message = self._slopes.note
        if ending is Ending.STALLED and self._progress.iteration > 0:
            ending = Ending.CONVERGED
            zero = abs(at.cost) <= FLOOR * self._largest
            message = message if zero or self._progress.optimality < NEARLY_OPTIMAL else AT_A_KINK
        if not at.feasible:
            ended = ending in (Ending.CONVERGED, Ending.STALLED)
            ending = Ending.INFEASIBLE if ended else ending
            message = worst_constraint(self._space, at)
        iterations = self._progress.iteration
        found = Solution(x, at.cost, ending, message, iterations, at=at)
        if self._feasibility_only or ending is Ending.DERIVATIVES_FAILED:
            return found
        if not self._around.is_known(x) and self._around.slopes.residuals is not None:
            yield from self._differentiate(x, at)
        jacobian = self._around.slopes.residuals
        if jacobian is None:
            return found
        return replace(found, jacobian=jacobian.matrix, difference_steps=jacobian.steps)

    def _differentiate(
        self, x: FloatArray, at: Evaluation
    ) -> Generator[Points, list[Evaluation], None]:
        """Ask for the derivatives, unless they came with the trial."""
        asking, ahead, self._ahead = self._derivatives(x, at), self._ahead, None
        if ahead is not None and np.array_equal(ahead[0], x):
            slopes = drive(asking, lambda points: ahead[1])
        else:
            slopes = yield from asking
        self._around.arrive(x, at, slopes, self._multipliers)

    def _derivatives(self, x: FloatArray, at: Evaluation) -> Asking:
        relative = self._settings.relative_step
        scheme = self._slopes.scheme or "forward"
        return derivatives(self._space, x, at, scheme, relative, self._progress, self._slopes)

    def _judge(self) -> Ending | None:
        """Whether a bold step still promises anything."""
        step = self._around.step(max(self._radius, FIRST_RADIUS))
        size = self._size(self._at)
        optimality = float(np.sqrt(max(step.promised, 0.0) / size)) if size > 0.0 else 0.0
        self._progress = replace(self._progress, optimality=optimality, damping=self._radius)
        changes = max(step.promised, abs(step.model.change(step.vector)))
        if changes <= self._settings.ftol * size or step.promised <= 0.0:
            return Ending.CONVERGED
        if self._progress.iteration >= self._settings.max_iterations:
            return Ending.MAX_ITERATIONS
        return None

    def _advance(self) -> Generator[Points, list[Evaluation], Ending | None]:
        """Try steps until one lowers the merit or the trust region is gone."""
        corrected = bent = False
        while self._radius > self._settings.xtol:
            trial = yield from self._try()
            spoiled = self._spoiled_by_constraints(trial)
            if spoiled and not corrected:
                corrected = True
                better = yield from self._correct(trial)
                if better.gained > max(trial.gained, ACCEPTED * trial.step.promised):
                    return self._accept(better)
            if trial.ratio >= ACCEPTED or self._found():
                return self._accept(trial)
            if spoiled and not bent and self._around.kinked(trial.step, trial.at):
                bent, corrected = True, False
                slopes = yield from self._derivatives(trial.x, trial.at)
                self._around.see_face(trial.x, trial.at, slopes)
                continue
            self._radius = SHRINK * min(self._radius, self._around.length(trial.step.vector))
        return Ending.STALLED

    def _try(self) -> Generator[Points, list[Evaluation], _TrialStep]:
        """The model's best step."""
        step = self._around.step(self._radius)
        x = self._inside(self._x + step.vector)
        points = x[None, :]
        if self._settings.speculative_gradient and self._slopes.scheme is not None:
            points = np.vstack([points, next(self._derivatives(x, self._at)).x])
        at, *others = yield Points(points, "trial", self._progress)
        self._ahead = (x, others) if others else None
        self._around.learn(step, at)
        return self._came_of(step, x, at)

    def _correct(self, trial: _TrialStep) -> Generator[Points, list[Evaluation], _TrialStep]:
        """The same step, corrected for bent constraints."""
        vector = self._around.corrected(trial.step, trial.at, self._radius)
        x = self._inside(self._x + vector)
        (at,) = yield Points(x[None, :], "correction", self._progress)
        return self._came_of(replace(trial.step, vector=x - self._x), x, at)

    def _came_of(self, step: ModelStep, x: FloatArray, at: Evaluation) -> _TrialStep:
        if at.rank < self._best[1].rank:
            self._best = (x, at)
        return _TrialStep(step, x, at, self._penalty.merit(self._at) - self._penalty.merit(at))

    def _spoiled_by_constraints(self, trial: _TrialStep) -> bool:
        """Whether less than half came of a step, and most of that because constraints bend."""
        step = trial.step
        if not usable(trial.at) or trial.gained > 0.5 * step.promised:
            return False
        excess = self._penalty.violations(trial.at) - step.model.violation(step.vector)
        return self._penalty.value * excess > 0.5 * (step.promised - trial.gained)

    def _accept(self, trial: _TrialStep) -> Ending | None:
        """Move to a trial point. Returns why to stop, if so."""
        length = self._around.length(trial.step.vector)
        self._radius = _radius(self._radius, trial.ratio, length)
        self._x, self._at, self._multipliers = trial.x, trial.at, trial.step.multipliers
        self._largest = max(self._largest, abs(trial.at.cost))
        self._progress = Progress(
            self._progress.iteration + 1,
            trial.at.cost,
            step=float(np.linalg.norm(trial.step.vector / self._space.typical)),
            optimality=self._progress.optimality,
            damping=self._radius,
            violation=self._shown(trial.at),
        )
        left = self._penalty.value * self._penalty.violations(trial.at)
        gained = max(trial.gained, trial.step.promised)
        if trial.at.feasible and gained + left <= self._settings.ftol * self._size(trial.at):
            return Ending.CONVERGED
        return Ending.STALLED if length <= self._settings.xtol else None

    def _found(self) -> bool:
        """Whether constraints are all there is, and they are satisfied."""
        return self._feasibility_only and self._best[1].feasible

    def _size(self, at: Evaluation) -> float:
        """What changes of the merit are compared with."""
        size = max(abs(at.cost), FLOOR * self._largest)
        return size if at.feasible else size + self._penalty.value * self._penalty.violations(at)

    def _inside(self, x: FloatArray) -> FloatArray:
        return np.clip(x, self._space.lower, self._space.upper)

    def _shown(self, at: Evaluation) -> float:
        return at.violation if len(at.constraints) else np.nan


def _radius(radius: float, ratio: float, length: float) -> float:
    """The next trust radius."""
    if ratio < POOR:
        return SHRINK * min(radius, length)
    if ratio >= GOOD and length >= 0.8 * radius:
        return WIDEN * radius
    return radius
