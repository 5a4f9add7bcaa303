"""Sequential quadratic programming with a trust region, for few and costly simulations.

An iteration makes two requests: the points of the derivatives, then one trial step. The step
minimises a quadratic model of the cost plus a penalty on the violation of the linearised
constraints. It stays within the bounds and a trust region (R. Fletcher, Practical Methods of
Optimization, 2nd ed. (1987), section 14.4). A rejected step costs one point, not new derivatives.

    merit          cost + penalty * violations; a step must reduce the merit
    local model    model at the current point, and its best step (local_model.py)
    correction     second-order correction of a step that violates curved constraints, from the
                   values of the constraints at its end
    kink           after a rejected step at a kink of a constraint, the derivatives at its end are
                   computed; from then on the linearisations on both sides are used
    rho            actual reduction of the merit over the predicted reduction
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
from typing_extensions import override

from cluster_est.methods.differences import Differences, without_guesses
from cluster_est.methods.gradients import CostDerivatives, JacobianProvider, derivatives
from cluster_est.methods.method import (
    CUT_SHORT,
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
    is_defined,
    undefined_reason,
    worst_constraint,
)
from cluster_est.methods.sqp.local_model import Hessian, ModelStep, SqpLocalModel
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

INITIAL_RADIUS = 1.0
"""Radius of the first trust region, in units of each unknown's size."""
REFINED_RADIUS = 1e-2
"""Least radius at the change to central differences."""
ACCEPTED_RATIO, POOR_RATIO, GOOD_RATIO = 0.05, 0.25, 0.75
"""Values of rho: least accepted value, and limits for shrinking and widening the region."""
RADIUS_REDUCTION, RADIUS_GROWTH = 0.25, 3.0
ZERO_COST = 1e-16
"""A cost this much smaller than the largest so far counts as zero."""
OPTIMALITY_TOLERANCE = 1e-3
AT_A_KINK = (
    "no step longer than xtol lowers the cost, but the gradient is not zero, as happens at a kink "
    "or with noisy simulations"
)

DerivativeRequests = Generator[Points, list[Evaluation], CostDerivatives]


@dataclass(frozen=True)
class Sqp(Method):
    """Sequential quadratic programming.

    Use it for costs with constraints, and for costs that are not sums of squares. It finds one
    local minimum, which depends on the start; use several starts to find others. For a sum of
    squares without constraints, `least_squares` is better. The method needs derivatives. If
    simulations jump or are noisy beyond their tolerance, use `pattern_search`.

    If there is no cost to minimise, it ends at the first point that satisfies all constraints.

    Attributes
    ----------
    algorithm
        "native": a trust-region method with Gauss-Newton curvature of the cost. It handles the
        kinks of constraints on the largest value of a signal. "slsqp" and "trust_constr" call
        SciPy, for comparison with well-known implementations. They need more simulations, and make
        slow progress at kinks.
    max_iterations
        Limit on the number of steps for "native", else on the number of derivatives.
    ftol
        Converged when the predicted and the actual change of the cost by a step are at most this
        part of the cost. "slsqp": its ftol, with the cost in units of its size at the start.
    xtol
        Converged when only steps shorter than this part of each unknown lower the cost, as at a
        kink. Not used by "slsqp".
    differences
        "forward", "central", or "auto": forward until converged, then central until the end. This
        removes the error of forward differences from the minimum. "sensitivities" uses no
        differences, for "native" and a cost with weights (see `LeastSquares`); else it is "auto".
    relative_step
        Relative step of the differences; 0 selects the step from the solver's noise.
    hessian
        "auto" uses the Gauss-Newton matrix or its quasi-Newton updates, whichever predicted the
        last steps better. "gauss_newton" suits good fits, "quasi_newton" large residuals. "slsqp"
        always uses updates. "trust_constr" uses the Gauss-Newton matrix unless this is
        "quasi_newton".
    speculative_gradient
        Evaluate the points of the derivatives together with each trial step ("native" only). This
        halves the number of requests, but wastes simulations if a step is rejected. Use it with
        more workers than unknowns.
    """

    name: ClassVar[str] = "sqp"
    needs_residuals: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    algorithm: Literal["native", "slsqp", "trust_constr"] = "native"
    max_iterations: int = field(default=100, metadata={"least": 1})
    ftol: float = field(default=1e-10, metadata={"least": 0.0})
    xtol: float = field(default=1e-6, metadata={"least": 0.0})
    differences: Differences = "auto"
    relative_step: float = field(default=0.0, metadata={"least": 0.0})
    hessian: Hessian = "auto"
    speculative_gradient: bool = False

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        if self.algorithm == "native":
            return trust_region_search(space, self)
        from cluster_est.methods.sqp.scipy_constrained import scipy_search  # slow to import

        return scipy_search(space, self)


def trust_region_search(space: SearchSpace, settings: Sqp) -> Search:
    """Minimise the cost of `space` under its bounds and constraints.

    The solution has the Jacobian of the residuals if the cost has weights.
    """
    x = space.start
    (at,) = yield Points(x[None, :], "start", Progress(0, np.nan))
    if not is_defined(at):
        return Solution(x, np.nan, Ending.START_FAILED, undefined_reason(at))
    search = _TrustRegionSearch(space, settings, x, at)
    ending: Ending | None = None
    while ending is None:
        ending = yield from search.iterate()
        if ending is not None and search.refine(ending):
            ending = None
    return (yield from search.solution(ending))


@dataclass(frozen=True)
class _TrialStep:
    """A step, the evaluation at its end, and the actual reduction of the merit."""

    step: ModelStep
    x: FloatArray
    at: Evaluation
    reduction: float

    @property
    def rho(self) -> float:
        """Actual over predicted reduction; -1 if no reduction is predicted."""
        predicted = self.step.predicted_reduction
        return self.reduction / predicted if predicted > 0.0 else -1.0


class _TrustRegionSearch:
    """State of one search: the current point, the model around it, and the trust region."""

    def __init__(self, space: SearchSpace, settings: Sqp, x: FloatArray, at: Evaluation) -> None:
        self._space, self._settings = space, settings
        weighted = space.problem.cost.weights(at.residuals, space.outputs) is not None
        differences = (
            settings.differences if weighted or settings.differences != "sensitivities" else "auto"
        )
        self._provider = JacobianProvider(space, differences, settings.relative_step)
        self._feasibility_only = at.residuals.size == 0
        self._model = SqpLocalModel(space, settings.hessian, self._feasibility_only)
        self._penalty = self._model.penalty
        self._x, self._at, self._best = x, at, (x, at)
        self._multipliers = np.zeros(len(space.constraint_names))
        self._shrunk_by_failures = False
        self._radius, self._largest_cost = INITIAL_RADIUS, abs(at.cost)
        self._speculative: tuple[FloatArray, list[Evaluation]] | None = None
        self._progress = Progress(0, at.cost, violation=self._table_violation(at))

    def iterate(self) -> Generator[Points, list[Evaluation], Ending | None]:
        """Compute derivatives and move to the next point. Return the ending, if any."""
        if self._feasible_point_suffices():
            return Ending.CONVERGED
        yield from self._differentiate(self._x, self._at)
        if self._model.derivatives.frozen.all():
            return Ending.DERIVATIVES_FAILED
        ending = self._convergence()
        return (yield from self._advance()) if ending is None else ending

    def refine(self, ending: Ending) -> bool:
        """Change to central differences after convergence; return whether the search goes on."""
        converged = ending is Ending.CONVERGED or (
            ending is Ending.STALLED and self._progress.optimality < OPTIMALITY_TOLERANCE
        )
        if not converged or self._feasible_point_suffices() or not self._provider.refine():
            return False
        self._speculative = None
        self._radius = max(self._radius, REFINED_RADIUS)
        return True

    def solution(self, ending: Ending) -> Search:
        """Return the feasible point of least merit, or else the point of least violation."""
        x, at = self._best
        if self._at.feasible and self._penalty.merit(self._at) <= self._penalty.merit(at):
            x, at = self._x, self._at
        message = self._provider.note
        if ending is Ending.STALLED and self._progress.iteration > 0:
            zero = abs(at.cost) <= ZERO_COST * self._largest_cost
            settled = zero or self._progress.optimality < OPTIMALITY_TOLERANCE
            if settled or not self._shrunk_by_failures:
                ending = Ending.CONVERGED
            message = message if settled else CUT_SHORT if self._shrunk_by_failures else AT_A_KINK
        if not at.feasible:
            ended = ending in (Ending.CONVERGED, Ending.STALLED)
            ending = Ending.INFEASIBLE if ended else ending
            message = worst_constraint(self._space, at)
        iterations = self._progress.iteration
        found = Solution(x, at.cost, ending, message, iterations, at=at)
        if self._feasibility_only or ending is Ending.DERIVATIVES_FAILED:
            return found
        found = without_guesses(self._space, found, self._model.derivatives.frozen)
        if not self._model.is_at(x) and self._model.derivatives.residual_jacobian is not None:
            yield from self._differentiate(x, at)
        jacobian = self._model.derivatives.residual_jacobian
        if jacobian is None:
            return found
        return jacobian.added_to(found, self._space, dense=True)

    def _differentiate(
        self, x: FloatArray, at: Evaluation
    ) -> Generator[Points, list[Evaluation], None]:
        """Compute the derivatives, unless they were evaluated with the trial."""
        requests, answered, self._speculative = self._derivatives(x, at), self._speculative, None
        if answered is not None and np.array_equal(answered[0], x):
            requests = _begun(requests, answered[1])
        found = yield from requests
        self._model.move_to(x, at, found, self._multipliers)

    def _derivatives(self, x: FloatArray, at: Evaluation) -> DerivativeRequests:
        relative = self._settings.relative_step
        scheme = self._provider.scheme or "forward"
        return derivatives(
            self._space, x, at, scheme, relative, self._progress, provider=self._provider
        )

    def _convergence(self) -> Ending | None:
        """Return an ending if a long step predicts no reduction, or at the limit of iterations."""
        step = self._model.step(max(self._radius, INITIAL_RADIUS))
        predicted, size = step.predicted_reduction, self._merit_scale(self._at)
        optimality = float(np.sqrt(max(predicted, 0.0) / size)) if size > 0.0 else 0.0
        self._progress = replace(self._progress, optimality=optimality, damping=self._radius)
        change = max(predicted, abs(step.model.change(step.vector)))
        if change <= self._settings.ftol * size or predicted <= 0.0:
            return Ending.CONVERGED
        if self._progress.iteration >= self._settings.max_iterations:
            return Ending.MAX_ITERATIONS
        return None

    def _advance(self) -> Generator[Points, list[Evaluation], Ending | None]:
        """Try steps until one reduces the merit or the trust region is too small."""
        corrected = linearised = False
        while self._radius > self._settings.xtol:
            trial = yield from self._try()
            violated = self._violates_constraints(trial)
            if violated and not corrected:
                corrected = True
                better = yield from self._correct(trial)
                least = max(trial.reduction, ACCEPTED_RATIO * trial.step.predicted_reduction)
                if better.reduction > least:
                    return self._accept(better)
            if trial.rho >= ACCEPTED_RATIO or self._feasible_point_suffices():
                return self._accept(trial)
            if violated and not linearised and self._model.has_kink(trial.step, trial.at):
                linearised, corrected = True, False
                found = yield from self._derivatives(trial.x, trial.at)
                self._model.add_linearisation(trial.x, trial.at, found)
                continue
            if not is_defined(trial.at):
                self._shrunk_by_failures = True
                if self._model.derivatives.walls.any() and not self._model.along_walls:
                    self._model.along_walls = True
                    continue
            self._radius = RADIUS_REDUCTION * min(
                self._radius, self._model.length(trial.step.vector)
            )
        return Ending.STALLED

    def _try(self) -> Generator[Points, list[Evaluation], _TrialStep]:
        """Evaluate the model's best step."""
        step = self._model.step(self._radius)
        x = self._clip(self._x + step.vector)
        points = x[None, :]
        if self._settings.speculative_gradient and self._provider.scheme is not None:
            points = np.vstack([points, next(self._derivatives(x, self._at)).x])
        at, *others = yield Points(points, "trial", self._progress)
        self._speculative = (x, others) if others else None
        self._model.compare(step, at)
        return self._trial(step, x, at)

    def _correct(self, trial: _TrialStep) -> Generator[Points, list[Evaluation], _TrialStep]:
        """Evaluate the step with its second-order correction."""
        vector = self._model.corrected(trial.step, trial.at, self._radius)
        x = self._clip(self._x + vector)
        (at,) = yield Points(x[None, :], "correction", self._progress)
        return self._trial(replace(trial.step, vector=x - self._x), x, at)

    def _trial(self, step: ModelStep, x: FloatArray, at: Evaluation) -> _TrialStep:
        if at.rank < self._best[1].rank:
            self._best = (x, at)
        return _TrialStep(step, x, at, self._penalty.merit(self._at) - self._penalty.merit(at))

    def _violates_constraints(self, trial: _TrialStep) -> bool:
        """Return whether rho is at most a half, mostly because constraints are curved."""
        step = trial.step
        if not is_defined(trial.at) or trial.reduction > 0.5 * step.predicted_reduction:
            return False
        excess = self._penalty.violations(trial.at) - step.model.violation(step.vector)
        return self._penalty.value * excess > 0.5 * (step.predicted_reduction - trial.reduction)

    def _accept(self, trial: _TrialStep) -> Ending | None:
        """Move to a trial point. Return the ending, if any."""
        length = self._model.length(trial.step.vector)
        self._radius = _next_radius(self._radius, trial.rho, length)
        self._shrunk_by_failures &= self._radius < REFINED_RADIUS
        self._x, self._at, self._multipliers = trial.x, trial.at, trial.step.multipliers
        self._largest_cost = max(self._largest_cost, abs(trial.at.cost))
        self._progress = Progress(
            self._progress.iteration + 1,
            trial.at.cost,
            step=float(np.linalg.norm(trial.step.vector / self._space.typical)),
            optimality=self._progress.optimality,
            damping=self._radius,
            violation=self._table_violation(trial.at),
        )
        violation = self._penalty.value * self._penalty.violations(trial.at)
        reduction = max(trial.reduction, trial.step.predicted_reduction)
        least = self._settings.ftol * self._merit_scale(trial.at)
        if self._model.derivatives.frozen.any() or self._model.along_walls:
            return None  # only a step with all derivatives may end the search
        if trial.at.feasible and reduction + violation <= least:
            return Ending.CONVERGED
        return Ending.STALLED if length <= self._settings.xtol else None

    def _feasible_point_suffices(self) -> bool:
        """Return whether there is nothing to minimise and the constraints are satisfied."""
        return self._feasibility_only and self._best[1].feasible

    def _merit_scale(self, at: Evaluation) -> float:
        """Return the scale of relative changes of the merit."""
        size = max(abs(at.cost), ZERO_COST * self._largest_cost)
        return size if at.feasible else size + self._penalty.value * self._penalty.violations(at)

    def _clip(self, x: FloatArray) -> FloatArray:
        return np.clip(x, self._space.lower, self._space.upper)

    def _table_violation(self, at: Evaluation) -> float:
        return at.violation if len(at.constraints) else np.nan


def _begun(requests: DerivativeRequests, answers: list[Evaluation]) -> DerivativeRequests:
    """Continue a generator of requests whose first request has its answers already."""
    next(requests)
    try:
        points = requests.send(answers)
        while True:
            points = requests.send((yield points))
    except StopIteration as end:
        found: CostDerivatives = end.value
        return found


def _next_radius(radius: float, rho: float, length: float) -> float:
    """Return the next trust radius, after a step of some length."""
    if rho < POOR_RATIO:
        return RADIUS_REDUCTION * min(radius, length)
    if rho >= GOOD_RATIO and length >= 0.8 * radius:
        return RADIUS_GROWTH * radius
    return radius
