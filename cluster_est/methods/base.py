"""The contract of a method: a generator that asks for points and is sent their evaluations.

    evaluations = yield Points(x, "trial")
    ...
    return Solution(...)

A method does not know where simulations run, in which order they end, or how many workers there
are. Everything in one `Points` may run at the same time; the evaluations come back in the order of
the rows. Resuming a run needs nothing from a method either: it is run again from the start and
answered from the log.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from cluster_est.space import Space
from workers.messages import FloatArray, Outcome


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
        How far from a minimum; 0 at one.
    damping
        The method's damping or mesh size.
    """

    iteration: int
    cost: float
    step: float = np.nan
    optimality: float = np.nan
    damping: float = np.nan


@dataclass(frozen=True)
class Points:
    """A request: evaluate the rows of `x`.

    Attributes
    ----------
    x : (points, unknowns)
        In search coordinates.
    purpose
        What for, in one word, for the log: "start", "jacobian", "trial", ...
    progress
        Where the method stands, for the display and the table.
    """

    x: FloatArray
    purpose: str
    progress: Progress | None = None


@dataclass(frozen=True)
class Evaluation:
    """The answer for one point: the outcome of each experiment, in their order.

    `cost` is NaN where a simulation failed.
    """

    outcomes: tuple[Outcome, ...] = field(repr=False)
    cost: float

    @property
    def ok(self) -> bool:
        return all(outcome.ok for outcome in self.outcomes)

    @property
    def residuals(self) -> FloatArray:
        """All residuals, experiment after experiment; only where `ok`."""
        return np.concatenate([_residuals(outcome) for outcome in self.outcomes])

    @property
    def reason(self) -> str:
        """Why the first failed simulation failed."""
        failed = [outcome for outcome in self.outcomes if not outcome.ok]
        return f"{failed[0].status}: {failed[0].message}" if failed else ""


def _residuals(outcome: Outcome) -> FloatArray:
    return np.zeros(0) if outcome.residuals is None else outcome.residuals


Search = Generator[Points, list[Evaluation], "Solution"]


class Ending(enum.StrEnum):
    """How a search ended. A member's text is what a person reads."""

    CONVERGED = "converged"
    PERFECT = "the residuals are zero"
    MAX_ITERATIONS = "stopped at the limit of iterations; raise method.options.max_iterations"
    STALLED = "no step lowers the cost any more, but the gradient is not zero"
    START_FAILED = "the start could not be simulated"
    DERIVATIVES_FAILED = "no derivative could be computed"
    BUDGET = "the budget is used up"
    INTERRUPTED = "interrupted"

    @property
    def success(self) -> bool:
        return self in (Ending.CONVERGED, Ending.PERFECT)


@dataclass(frozen=True)
class Solution:
    """What a search found.

    Attributes
    ----------
    x : (unknowns,)
        The best point, in search coordinates.
    cost
        Its cost; NaN if not even the start could be simulated.
    ending, message
        Why it stopped.
    iterations
        How many.
    jacobian : (residuals, unknowns) or None
        d residuals / d x at `x`, where the method has it.
    difference_steps : (unknowns,) or None
        Steps of its finite differences, in search coordinates.
    at
        The evaluation at `x`, where the method has it.
    """

    x: FloatArray
    cost: float
    ending: Ending
    message: str = ""
    iterations: int = 0
    jacobian: FloatArray | None = field(default=None, repr=False)
    difference_steps: FloatArray | None = field(default=None, repr=False)
    at: Evaluation | None = field(default=None, repr=False)


class Method(ABC):
    """What picks the next points. Its attributes are its options."""

    name: ClassVar[str]
    """What the config calls it."""

    needs_sum_of_squares: ClassVar[bool]
    """Whether it works on residuals rather than on a cost of any kind."""

    def check(self, space: Space) -> None:  # noqa: B027 - a method may have nothing to refuse
        """Refuse, before anything is simulated, a space that this method cannot search.

        Raises
        ------
        ProblemError
            With what to change. The default accepts every space.
        """

    @abstractmethod
    def search(self, space: Space, generator: np.random.Generator) -> Search:
        """Start a search.

        Parameters
        ----------
        space
            The unknowns, their starts and bounds.
        generator
            The only source of chance that a method may use.
        """
