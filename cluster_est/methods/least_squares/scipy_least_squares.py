"""`scipy.optimize.least_squares`, with Jacobians by coloured differences, one request each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.callback_bridge import (
    MOST_SCIPY_RUNS,
    Ask,
    run_with,
    search_in_thread,
)
from cluster_est.methods.differences import (
    STEP_REDUCTION,
    Scheme,
    jacobian,
    suitable_step,
    without_guesses,
)
from cluster_est.methods.method import (
    CUT_SHORT,
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

FAILED_RESIDUAL = 1e100
"""Residual of a failed evaluation; it makes SciPy shorten its step."""

BY_XTOL = 3
"""SciPy's status after a step shorter than xtol."""
NEARLY_ORTHOGONAL = 1e-3
"""Cosine between the residuals and a column below which a stalled search counts as converged."""


class _StartFailedError(Exception):
    """Raised through SciPy if the start cannot be simulated."""


@dataclass(frozen=True)
class ScipyLeastSquares(Method):
    """SciPy's trust region reflective, dogleg or MINPACK's Levenberg-Marquardt.

    Use it to compare with a well-known implementation. It makes one trial step at a time, so it
    keeps at most as many workers busy as there are experiments.

    Attributes
    ----------
    algorithm
        "trf", "dogbox" or "lm"; "lm" does not support bounds.
    max_evaluations
        SciPy's max_nfev, without the evaluations of Jacobians; 0 selects SciPy's default.
    ftol, xtol, gtol
        Tolerances as SciPy defines them. Unknowns are in units of their typical sizes. Residuals
        are in units of their norm at the start if that is below 1.
    differences, relative_step
        Scheme and relative step of the Jacobian; 0 selects the step from the solver's noise.
    """

    name: ClassVar[str] = "scipy_least_squares"
    needs_residuals: ClassVar[bool] = True

    algorithm: Literal["trf", "dogbox", "lm"] = "trf"
    max_evaluations: int = field(default=0, metadata={"least": 0})
    ftol: float = field(default=1e-10, metadata={"least": 0.0})
    xtol: float = field(default=1e-10, metadata={"least": 0.0})
    gtol: float = field(default=1e-10, metadata={"least": 0.0})
    differences: Literal["forward", "central"] = "forward"
    relative_step: float = field(default=0.0, metadata={"least": 0.0})

    @override
    def check(self, space: SearchSpace) -> None:
        cost = space.problem.cost
        if not isinstance(cost, SumSquared):
            raise ProblemError(
                f"method.name: {self.name} minimises the sum of squares, but cost.name is "
                f'{cost.name!r}; use method "least_squares", which supports other costs by '
                'weighting the residuals, or cost "sse"'
            )
        bounded = np.isfinite(space.lower).any() or np.isfinite(space.upper).any()
        if self.algorithm == "lm" and bounded:
            raise ProblemError(
                'method.options.algorithm: "lm" does not support bounds, but a parameter has some; '
                'use "trf" or remove the bounds'
            )

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        return search_in_thread(lambda ask: self._solve(space, ask))

    def _solve(self, space: SearchSpace, ask: Ask) -> Solution:
        cache = _LastEvaluation(space, ask)
        scheme: Scheme = self.differences
        relative = self.relative_step or suitable_step(space, scheme)

        unit = 2.0 ** np.round(np.log2(space.typical))

        def residuals(z: FloatArray) -> FloatArray:
            return cache.residuals(z * unit) / cache.size

        def derivatives(z: FloatArray) -> FloatArray:
            x = z * unit
            at = cache.evaluation(x)
            requests = jacobian(space, x, at, scheme, relative, cache.progress)
            found = run_with(requests, ask)
            cache.steps, cache.frozen_before, cache.frozen = found.steps, cache.frozen, found.frozen
            return found.matrix * unit / cache.size

        start, bounds = space.start / unit, (space.lower / unit, space.upper / unit)
        try:
            for _ in range(MOST_SCIPY_RUNS):
                cache.frozen = cache.frozen_before = np.zeros(space.size, dtype=bool)
                cache.failures = 0
                result = self._run(residuals, derivatives, start, bounds)
                start, relative = result.x, STEP_REDUCTION * relative
                short = result.status == BY_XTOL and cache.failures > 0
                if result.status <= 0 or not cache.guessed.any():
                    break
        except _StartFailedError as failure:
            return Solution(space.start, np.nan, Ending.START_FAILED, str(failure))
        ending = _ending(result, short)
        found = Solution(
            x=result.x * unit,
            cost=cache.evaluation(result.x * unit).cost,
            ending=ending,
            message=CUT_SHORT if ending is Ending.STALLED else result.message,
            iterations=cache.progress.iteration,
            jacobian=result.jac / unit * cache.size,
            difference_steps=cache.steps,
            frozen=cache.frozen,
        )
        return without_guesses(space, found, cache.guessed)

    def _run(
        self,
        residuals: Callable[[FloatArray], FloatArray],
        derivatives: Callable[[FloatArray], FloatArray],
        start: FloatArray,
        bounds: tuple[FloatArray, FloatArray],
    ) -> Any:
        """Run SciPy from a point, and return its result."""
        from scipy.optimize import least_squares  # imported here because the import is slow

        with np.errstate(over="ignore"):  # a trial step may overflow; its cost is then infinite
            return least_squares(
                residuals,
                start,
                jac=derivatives,
                bounds=bounds if self.algorithm != "lm" else (-np.inf, np.inf),
                method=self.algorithm,
                ftol=_tolerance(self.ftol),
                xtol=_tolerance(self.xtol),
                gtol=_tolerance(self.gtol),
                x_scale="jac",
                max_nfev=self.max_evaluations or None,
            )


class _LastEvaluation:
    """Cache of the last evaluation, so that a Jacobian does not evaluate its point again."""

    def __init__(self, space: SearchSpace, ask: Ask) -> None:
        self._space, self._ask = space, ask
        self._x: FloatArray | None = None
        self._at: Evaluation | None = None
        self.progress = Progress(0, np.nan)
        self.steps: FloatArray | None = None
        self.failures = 0
        """Number of points of this run of SciPy that failed; each one shortens the next steps."""
        self.size = 1.0
        """A power of two that divides SciPy's residuals.

        SciPy's `gtol` is absolute, so small residuals would end the search too early."""
        self.frozen = self.frozen_before = np.zeros(space.size, dtype=bool)

    @property
    def guessed(self) -> npt.NDArray[np.bool_]:
        """Unknowns without derivatives in one of the last two Jacobians."""
        return self.frozen | self.frozen_before

    def evaluation(self, x: FloatArray) -> Evaluation:
        if self._at is None or self._x is None or not np.array_equal(x, self._x):
            first = self._at is None
            purpose = "start" if first else "trial"
            (at,) = self._ask(Points(x[None, :].copy(), purpose, self.progress))
            if first and not at.ok:
                raise _StartFailedError(at.reason)
            if first:
                size = float(np.linalg.norm(at.residuals))
                self.size = 2.0 ** min(round(math.log2(size)), 0) if size > 0.0 else 1.0
            self._x, self._at = x.copy(), at
            self.failures += not at.ok
            if at.ok and not at.cost >= self.progress.cost:
                self.progress = Progress(0 if first else self.progress.iteration + 1, at.cost)
        return self._at

    def residuals(self, x: FloatArray) -> FloatArray:
        at = self.evaluation(x)
        if at.ok:
            return at.residuals
        return np.full(self._space.rows[-1].stop, FAILED_RESIDUAL)


def _ending(result: Any, cut_short: bool) -> Ending:
    """Return the ending of a run of SciPy; failures may have cut the last steps short."""
    if result.status <= 0:
        return Ending.MAX_ITERATIONS
    norms = np.linalg.norm(result.jac, axis=0) * np.linalg.norm(result.fun)
    free = (norms > 0.0) & (result.active_mask * result.grad <= 0.0)
    cosines = np.abs(result.grad[free]) / norms[free]
    steep = bool(np.max(cosines, initial=0.0) > NEARLY_ORTHOGONAL)
    return Ending.STALLED if cut_short and steep else Ending.CONVERGED


def _tolerance(value: float) -> float | None:
    """Return a tolerance for SciPy; None disables the criterion."""
    return value if value > 0.0 else None
