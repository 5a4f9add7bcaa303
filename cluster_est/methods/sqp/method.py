"""Minimisation of any cost under bounds and constraints, by gradients."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from typing_extensions import override

from cluster_est.methods.base import Method, Search
from cluster_est.methods.derivatives.differences import Differences
from cluster_est.methods.sqp.hessian import Hessian
from cluster_est.methods.sqp.trust_region import SqpOptions, trust_region_search
from cluster_est.problem.search_space.space import SearchSpace


@dataclass(frozen=True)
class Sqp(Method):
    """Sequential quadratic programming.

    For a cost under constraints, and for costs that are no sum of squares. It finds the minimum
    that the start leads to; for others use several starts. Without constraints `least_squares` is
    better where the cost is a sum of squares. It needs derivatives: where simulations jump or are
    noisy beyond their tolerance, use `pattern_search`.

    Where there is nothing to minimise it ends at the first point that satisfies all constraints.

    Attributes
    ----------
    algorithm
        "native": a trust region with the Gauss-Newton curvature of the cost, which sees the kinks
        of constraints on the largest value of a signal. "slsqp" and "trust_constr" are SciPy's, to
        compare with well-known implementations; they need more simulations, and creep at kinks.
    max_iterations
        Limit on the number of steps for "native", else on the number of derivatives.
    ftol
        Converged when the predicted and the actual change of the cost by a step are at most this
        part of it. "slsqp": its ftol, with the cost in units of its size at the start.
    xtol
        Converged when only steps shorter than this part of each unknown lower the cost, as at a
        kink. Not used by "slsqp".
    differences
        "forward", "central", or "auto": forward until converged, then central to the end, which
        removes the error that forward differences leave in the minimum. "sensitivities", for
        "native" and a cost with weights: none, see `LeastSquares`; else as "auto".
    relative_step
        Relative step of the differences; 0 takes the one that suits the solver's noise.
    hessian
        "auto" takes Gauss-Newton's matrix or quasi-Newton updates of it, whichever predicted the
        last steps better. "gauss_newton" suits good fits, "quasi_newton" large residuals. "slsqp"
        has updates only, "trust_constr" Gauss-Newton's unless this is "quasi_newton".
    speculative_gradient
        Ask for the points of the derivatives together with each trial step ("native" only): half
        as many requests, but wasted simulations where a step is rejected. Worth it with more
        workers than unknowns.
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
        settings = SqpOptions(
            self.max_iterations,
            self.ftol,
            self.xtol,
            self.differences,
            self.relative_step,
            self.hessian,
            self.speculative_gradient,
        )
        if self.algorithm == "native":
            return trust_region_search(space, settings)
        from cluster_est.methods.sqp.scipy_constrained import scipy_search  # slow to import

        return scipy_search(space, settings, self.algorithm)
