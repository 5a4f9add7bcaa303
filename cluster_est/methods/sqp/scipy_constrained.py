"""SciPy's constrained minimisers on the farm: SLSQP, and the trust region `trust-constr`.

They see unknowns in units of their typical sizes and a cost that is 1 or less at the start, because
their tolerances are absolute. They know no failed simulation: they are told of a cost so large that
they shorten their step. Whatever they return, the best point that they asked for is the solution.

References: D. Kraft, ACM TOMS 20 (1994) 262-281, doi:10.1145/192115.192124; R. H. Byrd, M. E.
Hribar, J. Nocedal, SIAM J. Optim. 9 (1999) 877-900, doi:10.1137/S1052623497325107.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from scipy.optimize import BFGS, Bounds, NonlinearConstraint, lsq_linear, minimize

from cluster_est.methods.base import (
    TOLERANCE,
    Ending,
    Evaluation,
    Progress,
    Search,
    Solution,
)
from cluster_est.methods.callback_bridge import Ask, search_in_thread
from cluster_est.methods.derivatives.differences import Scheme
from cluster_est.methods.derivatives.gradients import CostDerivatives
from cluster_est.methods.sqp.evaluation_cache import (
    EvaluationCache,
    usable,
    why_unusable,
    worst_constraint,
)
from cluster_est.methods.sqp.trust_region import SqpOptions
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

Algorithm = Literal["slsqp", "trust_constr"]
FAILED_COST = 1e10
ENDLESS = 1_000_000
"""SciPy's limit of iterations: ours is on the number of derivatives."""
GRADIENT_TOLERANCE = 1e-14
"""Next to none: trust-constr takes a stationary point of its barrier for one of the problem."""
INSIDE = 0.01
"""How far from a bound the barrier of trust-constr must begin, in typical sizes."""


class _FoundError(Exception):
    """A feasible point, where nothing else is wanted."""


class _LimitError(Exception):
    pass


class _QuietBFGS(BFGS):  # type: ignore[misc]
    """SciPy's, without its warning that a function is linear."""

    def update(self, delta_x: FloatArray, delta_grad: FloatArray) -> None:
        if np.any(delta_grad != 0.0):
            super().update(delta_x, delta_grad)


def scipy_search(space: SearchSpace, settings: SqpOptions, algorithm: Algorithm) -> Search:
    """Minimise the cost of `space` under its bounds and constraints with SciPy."""
    return search_in_thread(lambda ask: _ScipyCallbacks(space, settings, ask).solve(algorithm))


class _ScipyCallbacks:
    """What SciPy calls, and what is known from its calls."""

    def __init__(self, space: SearchSpace, settings: SqpOptions, ask: Ask) -> None:
        self._space, self._settings = space, settings
        self._equality = space.equality
        scheme: Scheme = "central" if settings.differences == "central" else "forward"
        self._known = EvaluationCache(space, ask, scheme, settings.relative_step)
        self._none = np.zeros(space.size)
        self._scale = 1.0
        self._last = self._none
        self._feasibility_only = False
        self._constraints_before: FloatArray = np.zeros(len(self._equality))

    def solve(self, algorithm: Algorithm) -> Solution:
        at = self._known.evaluation(self._none)
        if not usable(at):
            return Solution(self._space.start, np.nan, Ending.START_FAILED, why_unusable(at))
        self._feasibility_only = at.residuals.size == 0
        run = {"slsqp": self._slsqp, "trust_constr": self._trust_constr}[algorithm]
        with np.errstate(all="ignore"):
            try:
                ending, message = self._once(run)
                if self._settings.differences in ("auto", "sensitivities"):
                    self._known.scheme = "central"
                    ending, message = self._once(run)
            except _FoundError:
                ending, message = Ending.CONVERGED, ""
            except _LimitError:
                ending, message = Ending.MAX_ITERATIONS, ""
        return self._solution(ending, message)

    def _once(self, run: Callable[[], tuple[Ending, str]]) -> tuple[Ending, str]:
        """Let SciPy start from the best point."""
        known = self._known
        if known.best is not None:
            known.origin = known.best[0]
        self._last = self._none
        at = self.evaluation(self._none)
        if self._feasibility_only:
            self._scale = 1.0
        else:
            slopes = known.slopes(self._none)
            if slopes.frozen.all():
                return Ending.DERIVATIVES_FAILED, ""
            steepest = float(np.abs(slopes.gradient * self._space.typical).max())
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
                        "jac": lambda z, m=mask, s=sign: s * self.constraint_slopes(z)[m],
                    }
                )
        found = minimize(
            self.cost,
            self._none,
            jac=self.gradient,
            method="SLSQP",
            bounds=list(zip(*self._bounds(), strict=True)),
            constraints=constraints,
            callback=lambda xk: self._note(xk),
            options={"ftol": self._settings.ftol, "maxiter": ENDLESS},
        )
        ending = Ending.CONVERGED if found.status == 0 else Ending.STALLED
        return ending, "" if found.status == 0 else f"SLSQP: {found.message}"

    def _trust_constr(self) -> tuple[Ending, str]:
        constraints = []
        if len(self._equality):
            lowest = np.where(self._equality, 0.0, -np.inf)
            constraints.append(
                NonlinearConstraint(
                    self.constraints, lowest, 0.0, self.constraint_slopes, hess=_QuietBFGS()
                )
            )
        lower, upper = self._bounds()
        bounded = bool(np.isfinite(lower).any() or np.isfinite(upper).any())
        options: dict[str, Any] = {
            "xtol": self._settings.xtol,
            "gtol": GRADIENT_TOLERANCE,
            "maxiter": ENDLESS,
        }
        if bounded or constraints:  # its default factorisation warns of dependent constraints
            options |= {"sparse_jacobian": False, "factorization_method": "SVDFactorization"}
        margin = np.minimum(INSIDE, 0.1 * (upper - lower))
        found = minimize(
            self.cost,
            np.clip(self._none, lower + margin, upper - margin),
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
        slopes = self._known.slopes(self._none) if not self._feasibility_only else None
        if slopes is None or slopes.curvature is None or self._settings.hessian == "quasi_newton":
            return _QuietBFGS()
        typical = self._space.typical

        def gauss_newton(z: FloatArray) -> FloatArray:
            curvature = self._known.slopes(z).curvature if usable(self.evaluation(z)) else None
            if curvature is None:
                return np.eye(len(typical))
            return np.asarray(curvature * np.outer(typical, typical) / self._scale)

        return gauss_newton

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        space, origin = self._space, self._known.origin
        return (space.lower - origin) / space.typical, (space.upper - origin) / space.typical

    def evaluation(self, z: FloatArray) -> Evaluation:
        at = self._known.evaluation(z)
        if self._feasibility_only and at.feasible:
            raise _FoundError
        return at

    def cost(self, z: FloatArray) -> float:
        at = self.evaluation(z)
        if not usable(at):
            return FAILED_COST
        return 0.5 * float(z @ z) if self._feasibility_only else at.cost / self._scale

    def gradient(self, z: FloatArray) -> FloatArray:
        if self._feasibility_only:
            return np.array(z)
        if not usable(self.evaluation(z)):
            return np.zeros(self._space.size)
        return np.asarray(self._slopes(z).gradient * self._space.typical / self._scale)

    def constraints(self, z: FloatArray) -> FloatArray:
        """Where a simulation failed, the values before: the cost alone says how bad it is."""
        at = self.evaluation(z)
        if usable(at):
            self._constraints_before = at.constraints
        return self._constraints_before

    def constraint_slopes(self, z: FloatArray) -> FloatArray:
        if not usable(self.evaluation(z)):
            return np.zeros((len(self._equality), self._space.size))
        return np.asarray(self._slopes(z).constraints * self._space.typical)

    def _slopes(self, z: FloatArray) -> CostDerivatives:
        known = self._known
        if not known.has_slopes(z) and known.gradients >= self._settings.max_iterations:
            raise _LimitError
        return known.slopes(z)

    def _note(self, z: FloatArray, state: Any = None) -> None:
        """Keep a line of the iteration table, from what is known already."""
        known = self._known
        if known.best is None:
            return
        at = known.best[1]
        known.progress = Progress(
            known.gradients,
            at.cost,
            step=float(np.linalg.norm(z - self._last)),
            optimality=self._optimality(z) if state is None else float(state.optimality),
            damping=np.nan if state is None else float(state.tr_radius),
            violation=at.violation if len(self._equality) else np.nan,
        )
        self._last = np.array(z)

    def _optimality(self, z: FloatArray) -> float:
        """The largest slope of the Lagrangian, for the multipliers that make it smallest."""
        if not self._known.has_slopes(z) or not usable(self._known.evaluation(z)):
            return self._known.progress.optimality
        at, lower, upper = self._known.evaluation(z), *self._bounds()
        active = self._equality | (at.constraints >= -TOLERANCE)
        low, high = z <= lower + TOLERANCE, z >= upper - TOLERANCE
        identity = np.eye(len(z))
        normals = np.vstack([self.constraint_slopes(z)[active], -identity[low], identity[high]])
        gradient = self.gradient(z)
        if not len(normals):
            return float(np.abs(gradient).max())
        least = np.concatenate(
            [np.where(self._equality[active], -np.inf, 0.0), np.zeros(low.sum() + high.sum())]
        )
        multipliers = lsq_linear(normals.T, -gradient, (least, np.inf)).x
        return float(np.abs(gradient + normals.T @ multipliers).max())

    def _solution(self, ending: Ending, message: str) -> Solution:
        known = self._known
        assert known.best is not None  # the start was evaluated
        x, at = known.best
        if not at.feasible:
            ended = ending in (Ending.CONVERGED, Ending.STALLED)
            ending = Ending.INFEASIBLE if ended else ending
            message = worst_constraint(self._space, at)
        found = Solution(x, at.cost, ending, message, known.progress.iteration, at=at)
        if self._feasibility_only or ending is Ending.DERIVATIVES_FAILED:
            return found
        if self._space.problem.cost.weights(at.residuals, self._space.outputs) is None:
            return found
        jacobian = known.slopes_at_best().residuals
        if jacobian is None:
            return found
        return replace(found, jacobian=jacobian.matrix, difference_steps=jacobian.steps)
