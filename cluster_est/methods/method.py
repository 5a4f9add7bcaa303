"""The interface of a method: a generator that yields points and receives their evaluations.

    evaluations = yield Points(x, "trial")
    ...
    return Solution(...)

A method does not depend on the place and order of the simulations, or on the number of workers. All
points of one `Points` may run at the same time. The evaluations are in the order of the rows. A
method needs no code to resume a run: the run starts again, and takes its evaluations from the log.

An asynchronous method yields `Points(..., asynchronous=True)`. It receives all evaluations that are
new, at least one. The `index` of an evaluation is the number of its point among all points of the
search. The method may yield no points in order to wait.
"""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.plug_in import check_class_attributes
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray, Outcome
from workers.messages.types import by_content


@dataclass(frozen=True)
class Progress:
    """A line of the iteration table.

    Attributes
    ----------
    iteration
        Number of the iteration; 0 is the start.
    cost
        Cost of the best point so far.
    step
        Length of the last step, in units of each unknown's own scale.
    optimality
        Distance from a minimum; 0 at a minimum.
    damping
        The method's damping, mesh or simplex size.
    violation
        Largest violation of a constraint at the best point; NaN without constraints.
    ending
        Name of the ending, in the last line of a search; the runner writes the last line.
    """

    iteration: int
    cost: float
    step: float = np.nan
    optimality: float = np.nan
    damping: float = np.nan
    violation: float = np.nan
    ending: str = ""


@by_content
@dataclass(frozen=True)
class Points:
    """A request: evaluate the rows of `x`.

    Attributes
    ----------
    x : (points, unknowns)
        In search coordinates.
    purpose
        Purpose in one word, for the log: "start", "jacobian", "trial", ...
    progress
        A line for the display and the table.
    asynchronous
        Return evaluations as soon as any point of this search is evaluated, and all that are.
    drop
        Indices of earlier asynchronous points to cancel; they get no evaluation.
    sensitivities
        Compute the derivatives of the residuals too, in `Outcome.sensitivities`, if the model
        supports them.
    follow_up
        Number of further points without which these points are useless. If the budget is too small
        for both, none is evaluated, and a `BudgetTooShortError` is raised in the search; see
        `within_budget`.
    bounds : (points,) or None
        Upper limits of the costs. A simulation may end early if its point exceeds the limit; the
        evaluation then is a failed one. Use them only if the method treats all points above the
        limit alike. They take effect if the cost is the sum of squares.
    """

    x: FloatArray
    purpose: str
    progress: Progress | None = None
    asynchronous: bool = False
    drop: tuple[int, ...] = ()
    sensitivities: bool = False
    follow_up: int = 0
    bounds: FloatArray | None = None


TOLERANCE = 1e-6
"""Largest violation that counts as none; constraints are in units of their own scale."""


@by_content
@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one point: the outcomes of all experiments, and cost and constraints.

    Attributes
    ----------
    outcomes
        One outcome for each experiment of the space, in their order.
    cost
        Cost of the point; NaN if a simulation failed.
    constraints : (constraints,)
        Values in the order of `SearchSpace.constraint_names`. A satisfied constraint is at most 0,
        or 0 if it is an equality (`SearchSpace.equality`). Empty without constraints or if a
        simulation failed.
    violation
        Largest violation of a constraint; 0 if all are satisfied, NaN if a simulation failed.
    index
        Number of the point among all points of its search.
    """

    outcomes: tuple[Outcome, ...] = field(repr=False)
    cost: float
    constraints: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    violation: float = 0.0
    index: int = -1

    @cached_property
    def ok(self) -> bool:
        return all(outcome.ok for outcome in self.outcomes)

    @property
    def feasible(self) -> bool:
        """True if it satisfies all constraints, to within `TOLERANCE`."""
        return self.ok and self.violation <= TOLERANCE

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, best first: feasible points by cost, then infeasible points by violation.

        These are the rules of K. Deb, Comput. Methods Appl. Mech. Engrg. 186 (2000) 311-338,
        doi:10.1016/S0045-7825(99)00389-8. Failed points are last.
        """
        if not self.ok or math.isnan(self.cost):
            return np.inf, np.inf
        return (0.0, self.cost) if self.feasible else (self.violation, self.cost)

    @property
    def residuals(self) -> FloatArray:
        """All residuals, experiment after experiment, with their priors; only if `ok`.

        If the method does not need every residual, a long experiment has one number for each
        output instead.
        """
        return joined_residuals(self.outcomes)

    @property
    def rows(self) -> list[slice]:
        """The rows of each experiment in `residuals`."""
        ends = np.cumsum([0, *(len(_residuals(outcome)) for outcome in self.outcomes)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    @property
    def steps(self) -> int:
        """Number of solver steps in all simulations; 0 if a solver does not count them."""
        return sum(outcome.steps for outcome in self.outcomes)

    @property
    def reason(self) -> str:
        """The status and message of the first simulation that failed; "" if none did."""
        failed = [outcome for outcome in self.outcomes if not outcome.ok]
        return f"{failed[0].status}: {failed[0].message}" if failed else ""


def joined_residuals(outcomes: Sequence[Outcome]) -> FloatArray:
    """Return the residuals of all outcomes, one after the other."""
    return np.concatenate([np.zeros(0), *(_residuals(outcome) for outcome in outcomes)])


def _residuals(outcome: Outcome) -> FloatArray:
    return np.zeros(0) if outcome.residuals is None else outcome.residuals


Search = Generator[Points, list[Evaluation], "Solution"]


class Ending(enum.StrEnum):
    """The reason why a search ended. A member's value is the text for the user."""

    CONVERGED = "converged"
    PERFECT = "the residuals are zero"
    MAX_ITERATIONS = (
        "stopped at the maximum number of iterations; raise method.options.max_iterations"
    )
    STALLED = "no further step lowers the cost, but the gradient is not zero"
    START_FAILED = "the start could not be simulated"
    DERIVATIVES_FAILED = "no derivative could be computed"
    DERIVATIVES_MISSING = "some derivatives could not be computed, so this may not be a minimum"
    NO_EFFECT = "no unknown affects the residuals, so there is no direction of descent"
    INFEASIBLE = "no point that satisfies the constraints was found"
    BUDGET = "the budget is used up"
    INTERRUPTED = "interrupted"

    @property
    def success(self) -> bool:
        return self in (Ending.CONVERGED, Ending.PERFECT)


@by_content
@dataclass(frozen=True)
class OtherPoint:
    """A point that a search found besides its solution; `objectives` are its separate costs."""

    x: FloatArray
    cost: float
    objectives: tuple[float, ...] = ()


@by_content
@dataclass(frozen=True)
class Solution:
    """The result of a search.

    Attributes
    ----------
    x : (unknowns,)
        The best point, in search coordinates.
    cost
        Cost at `x`; NaN if the start could not be simulated.
    ending, message
        The reason why the search ended.
    iterations
        Number of iterations.
    jacobian : (residuals, unknowns) or None
        d residuals / d x at `x`, if the method computes it and it is not too large.
    block_jacobian
        The same Jacobian as blocks of experiments, if it is too large for one array.
    difference_steps : (unknowns,) or None
        Steps of the Jacobian's finite differences, in search coordinates.
    frozen : (unknowns,) or None
        Unknowns whose column is 0 because simulations failed; None if there are none.
    at
        The evaluation at `x`, if the method has it. The evaluation of a fit has every residual,
        unless the point could not be simulated again.
    others
        Further points, best first: a Pareto front, or the minima of other starts.
    evaluations
        Evaluations of all points in their order, if the method only evaluates given points.
    """

    x: FloatArray
    cost: float
    ending: Ending
    message: str = ""
    iterations: int = 0
    jacobian: FloatArray | None = field(default=None, repr=False)
    block_jacobian: BlockMatrix | None = field(default=None, repr=False)
    difference_steps: FloatArray | None = field(default=None, repr=False)
    frozen: npt.NDArray[np.bool_] | None = field(default=None, repr=False)
    at: Evaluation | None = field(default=None, repr=False)
    others: tuple[OtherPoint, ...] = field(default=(), repr=False)
    evaluations: tuple[Evaluation, ...] = field(default=(), repr=False)


class Method(ABC):
    """A search method; its attributes are its options."""

    name: ClassVar[str]
    """Name of the method in a config."""

    needs_residuals: ClassVar[bool]
    """True if the method works on residuals with `Cost.weights`; False if any cost suits."""

    needs_every_residual: ClassVar[bool] = True
    """True if the method uses single residuals.

    If False, a long experiment may have one number for each output instead of its residuals
    (`Cost.reduction`). Costs are the same to rounding. The space assigns the numbers to outputs."""

    keeps_constraints: ClassVar[bool] = False
    """True if the method supports constraints other than bounds."""

    keeps_equality: ClassVar[bool] = True
    """True if the method supports equality constraints; irrelevant without `keeps_constraints`."""

    needs_bounds: ClassVar[bool] = False
    """True if every unknown must have finite bounds; `check` must test this."""

    asynchronous: ClassVar[bool] = False
    """True if the result may depend on the order in which simulations end."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    def check(self, space: SearchSpace) -> None:  # noqa: B027 - a method may have nothing to refuse
        """Raise an error, before any simulation, if this method cannot search a space.

        The default accepts every space.

        Raises
        ------
        ProblemError
            With a message that names the necessary change.
        """

    @abstractmethod
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        """Start a search.

        Parameters
        ----------
        space
            The unknowns, their starts and bounds.
        generator
            The only random number generator that a method may use.
        """


CUT_SHORT = (
    f"{Ending.STALLED}: the steps became too short, because simulations at longer steps failed"
)
"""Message of a search that stalled because simulations at longer steps failed."""


def is_defined(at: Evaluation) -> bool:
    """Return whether an evaluation has a cost and a value of every constraint."""
    return at.ok and not np.isnan(at.cost) and not bool(np.isnan(at.constraints).any())


def undefined_reason(at: Evaluation) -> str:
    """Return the reason why the values of an evaluation are undefined, for a message."""
    return at.reason or "the cost or a constraint has no value at this point"


def worst_constraint(space: SearchSpace, at: Evaluation) -> str:
    """Return a sentence with the most violated constraint and its violation; "" without one."""
    values = at.constraints
    if not len(values):
        return ""
    sizes = np.where(space.equality, np.abs(values), np.maximum(values, 0.0))
    worst = int(np.argmax(np.where(np.isnan(sizes), np.inf, sizes)))
    name = space.constraint_names[worst]
    return f"the constraint {name!r} is violated most, by {sizes[worst]:.3g} times its scale"


RequestResult = TypeVar("RequestResult")


class BudgetTooShortError(Exception):
    """The budget is too small for points and their follow-up points; see `Points.follow_up`.

    It is raised in a search. The search catches it, and goes on with fewer points or ends.
    """


def within_budget(
    requests: Generator[Points, list[Evaluation], RequestResult], follow_up: int
) -> Generator[Points, list[Evaluation], RequestResult | None]:
    """Make requests that are useless without some further points.

    Returns the result of the requests. Returns None if the budget is too small for a request and
    the follow-up points.
    """
    answers: list[Evaluation] | None = None
    while True:
        try:
            points = next(requests) if answers is None else requests.send(answers)
        except StopIteration as end:
            returned: RequestResult = end.value
            return returned
        try:
            answers = yield replace(points, follow_up=follow_up)
        except BudgetTooShortError:
            requests.close()
            return None


@by_content
@dataclass(frozen=True)
class GivenPoints(Method):
    """Evaluate given points and return the best of them, with all evaluations.

    Attributes
    ----------
    points : (points, unknowns)
        The points, in search coordinates.
    purpose
        Purpose of the points, for the log.
    """

    name: ClassVar[str] = "look"
    needs_residuals: ClassVar[bool] = False

    keeps_constraints: ClassVar[bool] = True

    points: FloatArray
    purpose: str

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        del space, generator  # the points are given
        found = tuple((yield Points(self.points, self.purpose)))
        ok = [i for i, evaluation in enumerate(found) if evaluation.ok]
        if not ok:
            first = found[0]
            return Solution(
                self.points[0],
                np.nan,
                Ending.START_FAILED,
                first.reason,
                at=first,
                evaluations=found,
            )
        best = min(ok, key=lambda i: found[i].rank)
        at = found[best]
        return Solution(self.points[best], at.cost, Ending.CONVERGED, at=at, evaluations=found)
