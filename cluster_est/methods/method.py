"""The contract of a method: a generator that asks for points and is sent their evaluations.

    evaluations = yield Points(x, "trial")
    ...
    return Solution(...)

A method does not know where simulations run, in which order they end, or how many workers there
are. Everything in one `Points` may run at the same time; the evaluations come back in the
order of the rows. Resuming a run needs nothing from a method either: it is run again from the
start and answered from the log.

An asynchronous method asks with `Points(..., asynchronous=True)` and is sent whatever has
come back since, at least one evaluation, each with its `index`: the number of the point among all
that the search has asked for. It may ask for no points, only to wait.
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
        0 is the start.
    cost
        Of the best point so far.
    step
        Length of the last step, in units of each unknown's own scale.
    optimality
        Distance from a minimum; 0 at one.
    damping
        The method's damping, mesh or simplex size.
    violation
        Largest violation of a constraint at the best point; NaN without constraints.
    ending
        Name of the ending, in the last line of a search; the runner writes that one.
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
        In one word, for the log: "start", "jacobian", "trial", ...
    progress
        A line for the display and the table.
    asynchronous
        Answer as soon as any point of this search is there, and with all that are.
    drop
        Indices of earlier asynchronous points that are not wanted any more; they are not answered.
    sensitivities
        Ask for the derivatives of the residuals too, in `Outcome.sensitivities`, where the model
        can give them.
    follow_up
        Further points without which these are of no use. Where a budget has no room for both, they
        are not evaluated, and a `BudgetTooShortError` is raised in the search; see `within_budget`.
    bounds : (points,) or None
        Costs above which nothing more need be known of a point, not even its cost: simulations of
        it may be ended early, and the answer is then that of a point that failed. Only for points
        that a method treats alike whatever they cost beyond the bound; it takes effect where the
        cost is the sum of squares.
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
"""A violation up to this counts as none: constraints are in units of their own scale."""


@by_content
@dataclass(frozen=True)
class Evaluation:
    """The answer for one point: the outcome of each experiment, in their order.

    Attributes
    ----------
    outcomes
        One for each experiment of the space.
    cost
        NaN where a simulation failed.
    constraints : (constraints,)
        In the order of `Space.constraint_names`: at most 0, or 0 where `Space.equality`, if they
        are satisfied. Empty where there are none, or a simulation failed.
    violation
        The largest of their violations; 0 where all are satisfied, NaN where a simulation failed.
    index
        The number of the point among all that its search has asked for.
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
        """Less is better: feasible points by their cost, all others by their violation.

        The rules of K. Deb, Comput. Methods Appl. Mech. Engrg. 186 (2000) 311-338,
        doi:10.1016/S0045-7825(99)00389-8. Failed points come last.
        """
        if not self.ok or math.isnan(self.cost):
            return np.inf, np.inf
        return (0.0, self.cost) if self.feasible else (self.violation, self.cost)

    @property
    def residuals(self) -> FloatArray:
        """All residuals, experiment after experiment, with their priors; only where `ok`.

        One number for each output instead, where the experiment is long and the method does not
        need every residual.
        """
        return joined_residuals(self.outcomes)

    @property
    def rows(self) -> list[slice]:
        """The rows of each experiment in `residuals`."""
        ends = np.cumsum([0, *(len(_residuals(outcome)) for outcome in self.outcomes)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    @property
    def steps(self) -> int:
        """Steps that the solver made in all simulations; 0 where a solver does not count them."""
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
    """The end of a search. A member's text is what a person reads."""

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
    """A point that a search found besides its solution; `objectives` are costs kept apart."""

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
        Its cost; NaN if not even the start could be simulated.
    ending, message
        The reason why it stopped.
    iterations
        Their number.
    jacobian : (residuals, unknowns) or None
        d residuals / d x at `x`, where the method has it and it is not too large.
    block_jacobian
        The same, experiment by experiment, where it is too large for one array.
    difference_steps : (unknowns,) or None
        Steps of its finite differences, in search coordinates.
    frozen : (unknowns,) or None
        Unknowns whose column is 0 because simulations for it failed; None where none did.
    at
        The evaluation at `x`, where the method has it. That of a fit has every residual, unless the
        point could not be simulated again.
    others
        Further points worth keeping, best first: a Pareto front, or the minima of other starts.
    evaluations
        Of every point in its order, where the method only evaluates points that it was given.
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
    """Its name in a config."""

    needs_residuals: ClassVar[bool]
    """True if it works on residuals, with `Cost.weights`, rather than on a cost of any kind."""

    needs_every_residual: ClassVar[bool] = True
    """True if it looks at single residuals. If not, long experiments may be answered with one
    number for each output in their place (`Cost.reduction`): costs are the same to rounding, and
    the space that it is given says what belongs to which output."""

    keeps_constraints: ClassVar[bool] = False
    """True if it can satisfy constraints other than bounds."""

    keeps_equality: ClassVar[bool] = True
    """True if these may be equalities too; means nothing without `keeps_constraints`."""

    needs_bounds: ClassVar[bool] = False
    """True if every unknown must have finite bounds, which `check` then asks for."""

    asynchronous: ClassVar[bool] = False
    """True if its result may depend on the order in which simulations end."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    def check(self, space: SearchSpace) -> None:  # noqa: B027 - a method may have nothing to refuse
        """Refuse, before anything is simulated, a space that this method cannot search.

        Raises
        ------
        ProblemError
            With what to change. The default accepts every space.
        """

    @abstractmethod
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        """Start a search.

        Parameters
        ----------
        space
            The unknowns, their starts and bounds.
        generator
            The only source of chance that a method may use.
        """


CUT_SHORT = (
    f"{Ending.STALLED}: the steps became too short, because simulations at longer steps failed"
)
"""The message of a search that ends there."""


def is_defined(at: Evaluation) -> bool:
    """Return whether an evaluation has a cost and a value of every constraint."""
    return at.ok and not np.isnan(at.cost) and not bool(np.isnan(at.constraints).any())


def undefined_reason(at: Evaluation) -> str:
    """Return why the values of an evaluation are not defined, for a message."""
    return at.reason or "the cost or a constraint has no value at this point"


def worst_constraint(space: SearchSpace, at: Evaluation) -> str:
    """Return a sentence on the constraint that is violated most, and by how much."""
    values = at.constraints
    if not len(values):
        return ""
    sizes = np.where(space.equality, np.abs(values), np.maximum(values, 0.0))
    worst = int(np.argmax(np.where(np.isnan(sizes), np.inf, sizes)))
    name = space.constraint_names[worst]
    return f"the constraint {name!r} is violated most, by {sizes[worst]:.3g} times its scale"


RequestResult = TypeVar("RequestResult")


class BudgetTooShortError(Exception):
    """A budget has no room for points and those that must follow them; see `Points.follow_up`.

    It is raised in a search, which catches it, and goes on with fewer points or ends.
    """


def within_budget(
    requests: Generator[Points, list[Evaluation], RequestResult], follow_up: int
) -> Generator[Points, list[Evaluation], RequestResult | None]:
    """Make requests that are of no use without some further points.

    Returns what they return; None where a budget has no room for one of them and the points that
    must follow.
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
    """Evaluate points, and end at the best of them; the solution carries all evaluations.

    Attributes
    ----------
    points : (points, unknowns)
        In search coordinates.
    purpose
        For the log.
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
