"""The residuals of a problem as a Python function, for other optimisers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, get_args

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.differences import Scheme, jacobian, without_guesses
from cluster_est.methods.method import Ending, Method, Points, Search, Solution
from cluster_est.problem.compatibility import check_observed_outputs, check_priors
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.arguments import checked_resources, prepared
from cluster_est.running.environment import open_executor
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import FloatArray
from workers.messages.checks import check_choice, shown


def residuals(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None = None,
    *,
    differences: Scheme = "forward",
) -> ResidualFunction:
    """Return the residuals of the training experiments as a function of the unknowns.

    ::

        with ce.residuals(problem) as f:
            found = scipy.optimize.least_squares(f, f.x0, jac=f.jac, bounds=f.bounds)
            print(f.physical(found.x))

    Use it for optimisers and analyses that are not among the methods. `fit` needs fewer sequential
    simulations, and gives intervals.

    Parameters
    ----------
    problem
        The problem. Its cost must be the sum of squares, without constraints, because residuals
        cannot express other problems.
    resources
        Where simulations run.
    differences
        Finite differences of `ResidualFunction.jac`: "forward" or "central".

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If residuals cannot express the problem, or the FMU cannot be run.
    """
    problem = prepared(problem)
    resources = checked_resources(resources)
    check_choice(differences, get_args(Scheme), "residuals: differences", ProblemError)
    problem.describe()
    space = make_space(problem, problem.indices("train"))
    _check(space)
    return ResidualFunction(space, resources, differences)


class ResidualFunction:
    """A function f(x) of the unknowns, whose workers run until it is closed.

    x contains physical values, or their natural logarithms if a parameter's scale is "log". If a
    simulation fails, all residuals are NaN. The methods "trf" and "dogbox" of
    `scipy.optimize.least_squares` then shorten their step, and refuse a failed start. `reason`
    contains the cause.

    Attributes
    ----------
    names
        Labels of the unknowns, such as "k" or "x0[exp5]".
    x0 : (unknowns,)
        Start values.
    bounds : two arrays (unknowns,)
        Lower and upper bounds.
    x_scale : (unknowns,)
        Sizes of noticeable changes, for `least_squares(..., x_scale=f.x_scale)`.
    reason
        The cause of the last failure, or the names of unknown derivatives; "" without failures.
    """

    def __init__(self, space: SearchSpace, resources: Resources, differences: Scheme) -> None:
        self._space, self._differences = space, differences
        self._executor = open_executor(space.problem, resources)
        self._runner = Runner(self._executor, resources.budget, whole=True)
        self._size = space.rows[-1].stop if len(space.outputs) else 0
        self._open = True
        self.reason = ""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(unknown.label for unknown in self._space.unknowns)

    @property
    def x0(self) -> FloatArray:
        return self._space.start.copy()

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        return self._space.lower.copy(), self._space.upper.copy()

    @property
    def x_scale(self) -> FloatArray:
        return self._space.typical.copy()

    def physical(self, x: FloatArray) -> dict[str, float]:
        """Return the physical values at x by label."""
        return self._space.estimates(self._checked(x))

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the residuals (measured - simulated) / sigma of all experiments: (residuals,).

        The residuals of an experiment are followed by those of the priors that belong to it.
        """
        at = self._run(_PointEvaluation(self._checked(x))).at
        if at is None or not at.ok:
            self.reason = "" if at is None else at.reason
            return np.full(self._size, np.nan)
        self._size = len(at.residuals)
        return at.residuals

    def jac(self, x: FloatArray) -> FloatArray:
        """Return the derivatives, (residuals, unknowns); all differences are simulated together.

        If the differences of an unknown fail on both sides and with several steps, its column is 0,
        so a method does not change it. `reason` then names it, and a search that ends there has not
        converged. If the simulation at x fails, all derivatives are NaN.
        """
        found = self._run(_PointEvaluation(self._checked(x), self._differences))
        if found.jacobian is not None:
            self.reason = found.message or self.reason
            return found.jacobian
        self.reason = "" if found.at is None else found.at.reason
        return np.full((self._size, self._space.size), np.nan)

    def close(self) -> None:
        """Stop the workers."""
        self._open = False
        self._executor.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self, point: _PointEvaluation) -> Solution:
        if not self._open:
            raise ProblemError(
                "residuals: must not be called after close, but is closed; create it again with "
                "residuals(problem)"
            )
        (solution,) = self._runner.run([SearchRequest("residuals", point, self._space)])
        return solution

    def _checked(self, x: FloatArray) -> FloatArray:
        try:
            point = np.array(x, np.float64)
        except (TypeError, ValueError):
            raise ProblemError(
                f"residuals: x must be a list of numbers, but is {shown(x)}; pass a vector like x0"
            ) from None
        if point.shape != (self._space.size,):
            raise ProblemError(
                f"residuals: x must have {self._space.size} numbers ({', '.join(self.names)}), but "
                f"has shape {point.shape}; pass a vector like x0"
            )
        return point


@dataclass(frozen=True, eq=False)
class _PointEvaluation(Method):
    """Evaluates one point, and its derivatives if `differences` is given."""

    name: ClassVar[str] = "residuals"
    needs_residuals: ClassVar[bool] = True

    x: FloatArray
    differences: Scheme | None = None

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        (at,) = yield Points(self.x[None, :], "point")
        if self.differences is None or not at.ok:
            return Solution(self.x, at.cost, Ending.CONVERGED, at=at)
        found = yield from jacobian(space, self.x, at, self.differences, 0.0, None)
        solution = Solution(self.x, at.cost, Ending.CONVERGED, jacobian=found.matrix, at=at)
        return without_guesses(space, solution, found.frozen)


def _check(space: SearchSpace) -> None:
    """Refuse problems that residuals cannot express."""
    problem = space.problem
    if space.size == 0:
        raise ProblemError(
            "parameters: at least one must be free, so that there is something to estimate from "
            "the training experiments, but all are fixed or known; for a simulation without "
            "estimation, use simulate(problem)"
        )
    if not isinstance(problem.cost, SumSquared):
        raise ProblemError(
            'cost.name: must be "sse" (residuals are for a sum of squares), but is '
            f'{problem.cost.name!r}; change it to "sse", or use fit'
        )
    check_priors(problem)
    check_observed_outputs(problem)
    if space.constraint_names:
        raise ProblemError(
            "constraints: residuals cannot express constraints, but there is "
            f"{space.constraint_names[0]!r}; remove the constraints, or use fit"
        )
