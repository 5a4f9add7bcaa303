"""SciPy's constrained minimisers: SLSQP, and the trust region `trust-constr`.

Their tolerances are absolute. So the unknowns are scaled by their typical sizes, and the cost is
scaled to at most 1 at the start. SciPy does not support failed simulations: a large cost in their
place makes it shorten the step. The solution is the best evaluated point, whatever SciPy returns.

References: D. Kraft, ACM TOMS 20 (1994) 262-281, doi:10.1145/192115.192124; R. H. Byrd, M. E.
Hribar, J. Nocedal, SIAM J. Optim. 9 (1999) 877-900, doi:10.1137/S1052623497325107.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import BFGS, Bounds, NonlinearConstraint, lsq_linear, minimize

from cluster_est.methods.callback_bridge import (
    MOST_SCIPY_RUNS,
    Ask,
    run_with,
    search_in_thread,
)
from cluster_est.methods.differences import (
    STEP_REDUCTION,
    Scheme,
    suitable_step,
    without_guesses,
)
from cluster_est.methods.gradients import CostDerivatives, derivatives
from cluster_est.methods.method import (
    CUT_SHORT,
    TOLERANCE,
    Ending,
    Evaluation,
    Points,
    Progress,
    Search,
    Solution,
    is_defined,
    undefined_reason,
    worst_constraint,
)
from cluster_est.methods.sqp.sqp import OPTIMALITY_TOLERANCE, Sqp
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

CAPACITY = 32
"""Points in the cache; SciPy requests only the last few points again."""


class EvaluationCache:
    """Evaluations and derivatives by point, and the best point.

    SciPy works on the scaled unknowns z = (x - origin) / typical. The origin is the start of the
    space, or a later point from which SciPy starts again.

    Parameters
    ----------
    space, ask
        The search space, and the function that evaluates points.
    scheme, relative_step
        Scheme and relative step of the differences; the scheme may be changed.
    """

    def __init__(self, space: SearchSpace, ask: Ask, scheme: Scheme, relative_step: float) -> None:
        self._space, self._ask, self._relative_step = space, ask, relative_step
        self._evaluations: OrderedDict[bytes, Evaluation] = OrderedDict()
        self._derivatives: OrderedDict[tuple[bytes, Scheme], CostDerivatives] = OrderedDict()
        self.origin = space.start
        self.scheme = scheme
        self.gradients = 0
        self.failures = 0
        """Number of points that failed; each one shortens the next steps."""
        self.progress = Progress(0, np.nan)
        self.best: tuple[FloatArray, Evaluation] | None = None

    def forget_derivatives(self) -> None:
        """Discard all derivatives, and reduce the relative step for new ones."""
        relative = self._relative_step or suitable_step(self._space, self.scheme)
        self._relative_step = STEP_REDUCTION * relative
        self._derivatives.clear()

    def point(self, z: FloatArray) -> FloatArray:
        """Return the point of the space, within bounds; exactly the origin if z is 0."""
        space = self._space
        return np.clip(self.origin + np.asarray(z) * space.typical, space.lower, space.upper)

    def evaluation(self, z: FloatArray) -> Evaluation:
        """Return the evaluation at z, from the cache if it is there."""
        x = self.point(z)
        key = x.tobytes()
        if key not in self._evaluations:
            purpose = "start" if self.best is None else "trial"
            (at,) = self._ask(Points(x[None, :], purpose, self.progress))
            self._evaluations[key] = at
            self.failures += not is_defined(at)
            if len(self._evaluations) > CAPACITY:
                self._evaluations.popitem(last=False)
            if self.best is None or at.rank < self.best[1].rank:
                self.best = (x, at)
        return self._evaluations[key]

    def derivatives(self, z: FloatArray) -> CostDerivatives:
        """Return the derivatives by x at z, from the cache if they are there."""
        return self._derivatives_at(self.point(z), self.evaluation(z))

    def derivatives_at_best(self) -> CostDerivatives:
        """Return the derivatives at the best point; there must be a best point."""
        assert self.best is not None
        return self._derivatives_at(*self.best)

    def _derivatives_at(self, x: FloatArray, at: Evaluation) -> CostDerivatives:
        key = (x.tobytes(), self.scheme)
        if key not in self._derivatives:
            self.gradients += 1
            requests = derivatives(
                self._space, x, at, self.scheme, self._relative_step, self.progress
            )
            self._derivatives[key] = run_with(requests, self._ask)
            if len(self._derivatives) > CAPACITY:
                self._derivatives.popitem(last=False)
        return self._derivatives[key]

    def has_derivatives(self, z: FloatArray) -> bool:
        """Return whether the derivatives at z are in the cache."""
        return (self.point(z).tobytes(), self.scheme) in self._derivatives


FAILED_COST = 1e10
ENDLESS = 1_000_000
"""SciPy's limit of iterations; `max_iterations` limits the number of derivatives instead."""
GRADIENT_TOLERANCE = 1e-14
"""Gradient tolerance of trust-constr.

With a larger one, a stationary point of its barrier function would end the search."""
STANDSTILL, STANDSTILLS = 1e-9, 5
"""Length of a negligible step of SLSQP, in typical sizes, and number of such steps in a row.

Such steps are below the error of finite differences. After that many of them at a feasible point,
SLSQP counts as converged."""
BARRIER_MARGIN = 0.01
"""Distance of the start of trust-constr from each bound, in typical sizes."""


class _FeasiblePointError(Exception):
    """Raised through SciPy at a feasible point if there is no cost to minimise."""


class _StandstillError(Exception):
    """Raised through SciPy after several negligible steps."""


class _LimitError(Exception):
    """Raised through SciPy at the limit of derivatives."""


class _QuietBFGS(BFGS):  # type: ignore[misc]
    """SciPy's BFGS updates, without the warning about linear functions."""

    def update(self, delta_x: FloatArray, delta_grad: FloatArray) -> None:
        if np.any(delta_grad != 0.0):
            super().update(delta_x, delta_grad)


def scipy_search(space: SearchSpace, settings: Sqp) -> Search:
    """Minimise the cost of `space` under its bounds and constraints with SciPy."""
    return search_in_thread(lambda ask: _ScipyCallbacks(space, settings, ask).solve())


class _ScipyCallbacks:
    """The functions that SciPy calls, with a common cache of evaluations."""

    def __init__(self, space: SearchSpace, settings: Sqp, ask: Ask) -> None:
        self._space, self._settings = space, settings
        self._equality = space.equality
        scheme: Scheme = "central" if settings.differences == "central" else "forward"
        self._cache = EvaluationCache(space, ask, scheme, settings.relative_step)
        self._origin = np.zeros(space.size)
        self._scale = 1.0
        self._last, self._standstills = self._origin, 0
        self._feasibility_only = False
        self._guessed = np.zeros(space.size, dtype=bool)
        """Unknowns with an unknown derivative at some point of the last run."""
        self._constraints_before: FloatArray = np.zeros(len(self._equality))

    def solve(self) -> Solution:
        at = self._cache.evaluation(self._origin)
        if not is_defined(at):
            return Solution(self._space.start, np.nan, Ending.START_FAILED, undefined_reason(at))
        self._feasibility_only = at.residuals.size == 0
        run = self._slsqp if self._settings.algorithm == "slsqp" else self._trust_constr
        with np.errstate(all="ignore"):
            try:
                ending, message = self._until_known(run)
                if self._settings.differences in ("auto", "sensitivities"):
                    self._cache.scheme = "central"
                    ending, message = self._until_known(run)
            except _FeasiblePointError:
                ending, message = Ending.CONVERGED, ""
            except _LimitError:
                ending, message = Ending.MAX_ITERATIONS, ""
        return self._solution(ending, message)

    def _until_known(self, run: Callable[[], tuple[Ending, str]]) -> tuple[Ending, str]:
        """Run SciPy; run it again from the best point if a derivative was unknown."""
        for i in range(MOST_SCIPY_RUNS):
            if i:
                self._cache.forget_derivatives()
            self._guessed = np.zeros(self._space.size, dtype=bool)
            ending, message = self._once(run)
            if ending is Ending.DERIVATIVES_FAILED or not self._guessed.any():
                break
        return ending, message

    def _once(self, run: Callable[[], tuple[Ending, str]]) -> tuple[Ending, str]:
        """Start SciPy from the best point."""
        cache = self._cache
        if cache.best is not None:
            cache.origin = cache.best[0]
        self._last, self._standstills = self._origin, 0
        at = self.evaluation(self._origin)
        if self._feasibility_only:
            self._scale = 1.0
        else:
            found = cache.derivatives(self._origin)
            if found.frozen.all():
                return Ending.DERIVATIVES_FAILED, ""
            steepest = float(np.abs(found.gradient * self._space.typical).max())
            self._scale = max(abs(at.cost), steepest) or 1.0
        return run()

    def _slsqp(self) -> tuple[Ending, str]:
        constraints = []
        for kind, mask, sign in (("eq", self._equality, 1.0), ("ineq", ~self._equality, -1.0)):
            if mask.any():
                constraints.append(
                    {
                        "type": kind,
                        "fun": lambda z, m=mask, s=sign: s * self.constraints(z)[m],
                        "jac": lambda z, m=mask, s=sign: s * self.constraint_jacobian(z)[m],
                    }
                )
        try:
            found = minimize(
                self.cost,
                self._origin,
                jac=self.gradient,
                method="SLSQP",
                bounds=list(zip(*self._bounds(), strict=True)),
                constraints=constraints,
                callback=self._note_slsqp,
                options={"ftol": self._settings.ftol, "maxiter": ENDLESS},
            )
        except _StandstillError:
            return Ending.CONVERGED, ""
        ending = Ending.CONVERGED if found.status == 0 else Ending.STALLED
        return ending, "" if found.status == 0 else f"SLSQP: {found.message}"

    def _trust_constr(self) -> tuple[Ending, str]:
        constraints = []
        if len(self._equality):
            lowest = np.where(self._equality, 0.0, -np.inf)
            constraints.append(
                NonlinearConstraint(
                    self.constraints, lowest, 0.0, self.constraint_jacobian, hess=_QuietBFGS()
                )
            )
        lower, upper = self._bounds()
        bounded = bool(np.isfinite(lower).any() or np.isfinite(upper).any())
        options: dict[str, Any] = {
            "xtol": self._settings.xtol,
            "gtol": GRADIENT_TOLERANCE,
            "maxiter": ENDLESS,
        }
        if bounded or constraints:  # the default factorisation warns of dependent constraints
            options |= {"sparse_jacobian": False, "factorization_method": "SVDFactorization"}
        margin = np.minimum(BARRIER_MARGIN, 0.1 * (upper - lower))
        found = minimize(
            self.cost,
            np.clip(self._origin, lower + margin, upper - margin),
            jac=self.gradient,
            hess=self._hessian(),
            method="trust-constr",
            bounds=Bounds(lower, upper, keep_feasible=True) if bounded else None,
            constraints=constraints,
            callback=lambda intermediate_result: self._note(
                intermediate_result.x, intermediate_result
            ),
            options=options,
        )
        return Ending.CONVERGED, f"trust-constr: {found.message}"

    def _hessian(self) -> Any:
        found = self._cache.derivatives(self._origin) if not self._feasibility_only else None
        if found is None or found.gauss_newton is None or self._settings.hessian == "quasi_newton":
            return _QuietBFGS()
        typical = self._space.typical

        def gauss_newton(z: FloatArray) -> FloatArray:
            defined = is_defined(self.evaluation(z))
            matrix = self._cache.derivatives(z).gauss_newton if defined else None
            if matrix is None:
                return np.eye(len(typical))
            return np.asarray(matrix * np.outer(typical, typical) / self._scale)

        return gauss_newton

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        space, origin = self._space, self._cache.origin
        return (space.lower - origin) / space.typical, (space.upper - origin) / space.typical

    def evaluation(self, z: FloatArray) -> Evaluation:
        at = self._cache.evaluation(z)
        if self._feasibility_only and at.feasible:
            raise _FeasiblePointError
        return at

    def cost(self, z: FloatArray) -> float:
        at = self.evaluation(z)
        if not is_defined(at):
            return FAILED_COST
        return 0.5 * float(z @ z) if self._feasibility_only else at.cost / self._scale

    def gradient(self, z: FloatArray) -> FloatArray:
        if self._feasibility_only:
            return np.array(z)
        if not is_defined(self.evaluation(z)):
            return np.zeros(self._space.size)
        return np.asarray(self._derivatives(z).gradient * self._space.typical / self._scale)

    def constraints(self, z: FloatArray) -> FloatArray:
        """Return the constraints; the last defined values if they are undefined here."""
        at = self.evaluation(z)
        if is_defined(at):
            self._constraints_before = at.constraints
        return self._constraints_before

    def constraint_jacobian(self, z: FloatArray) -> FloatArray:
        if not is_defined(self.evaluation(z)):
            return np.zeros((len(self._equality), self._space.size))
        return np.asarray(self._derivatives(z).constraint_jacobian * self._space.typical)

    def _derivatives(self, z: FloatArray) -> CostDerivatives:
        cache = self._cache
        if not cache.has_derivatives(z) and cache.gradients >= self._settings.max_iterations:
            raise _LimitError
        found = cache.derivatives(z)
        self._guessed |= found.frozen
        return found

    def _note_slsqp(self, z: FloatArray) -> None:
        """Add a line to the iteration table, and end SLSQP after negligible steps."""
        moved = float(np.abs(z - self._last).max())
        self._note(z)
        self._standstills = self._standstills + 1 if moved <= STANDSTILL else 0
        if self._standstills >= STANDSTILLS and self._cache.evaluation(z).feasible:
            raise _StandstillError

    def _note(self, z: FloatArray, state: Any = None) -> None:
        """Add a line to the iteration table, without further evaluations."""
        cache = self._cache
        if cache.best is None:
            return
        at = cache.best[1]
        cache.progress = Progress(
            cache.gradients,
            at.cost,
            step=float(np.linalg.norm(z - self._last)),
            optimality=self._optimality(z) if state is None else float(state.optimality),
            damping=np.nan if state is None else float(state.tr_radius),
            violation=at.violation if len(self._equality) else np.nan,
        )
        self._last = np.array(z)

    def _optimality(self, z: FloatArray) -> float:
        """Return the largest derivative of the Lagrangian at least-squares multipliers."""
        if not self._cache.has_derivatives(z) or not is_defined(self._cache.evaluation(z)):
            return self._cache.progress.optimality
        at, lower, upper = self._cache.evaluation(z), *self._bounds()
        active = self._equality | (at.constraints >= -TOLERANCE)
        low, high = z <= lower + TOLERANCE, z >= upper - TOLERANCE
        identity = np.eye(len(z))
        normals = np.vstack([self.constraint_jacobian(z)[active], -identity[low], identity[high]])
        gradient = self.gradient(z)
        if not len(normals):
            return float(np.abs(gradient).max())
        least = np.concatenate(
            [np.where(self._equality[active], -np.inf, 0.0), np.zeros(low.sum() + high.sum())]
        )
        multipliers = lsq_linear(normals.T, -gradient, (least, np.inf)).x
        return float(np.abs(gradient + normals.T @ multipliers).max())

    def _cut_short(self, x: FloatArray) -> bool:
        """Return whether failures ended the search at a point that is not optimal."""
        if self._feasibility_only or not self._cache.failures:
            return False
        self._cache.origin = x
        self._cache.derivatives(self._origin)
        return self._optimality(self._origin) > OPTIMALITY_TOLERANCE

    def _solution(self, ending: Ending, message: str) -> Solution:
        cache = self._cache
        assert cache.best is not None  # the start was evaluated
        x, at = cache.best
        if not at.feasible:
            ended = ending in (Ending.CONVERGED, Ending.STALLED)
            ending = Ending.INFEASIBLE if ended else ending
            message = worst_constraint(self._space, at)
        if ending is Ending.CONVERGED and self._cut_short(x):
            ending, message = Ending.STALLED, CUT_SHORT
        found = Solution(x, at.cost, ending, message, cache.progress.iteration, at=at)
        if self._feasibility_only or ending is Ending.DERIVATIVES_FAILED:
            return found
        found = without_guesses(self._space, found, self._guessed)
        if self._space.problem.cost.weights(at.residuals, self._space.outputs) is None:
            return found
        jacobian = cache.derivatives_at_best().residual_jacobian
        if jacobian is None:
            return found
        return jacobian.added_to(found, self._space, dense=True)
