"""A search in progress: what it has asked for, what has come back, and what it is sent."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    Points,
    Progress,
    Search,
    Solution,
    joined_residuals,
)
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.records import SearchIteration
from workers.messages import Effect, FloatArray, Outcome, Want


def assemble_evaluation(
    space: SearchSpace, x: FloatArray, outcomes: tuple[Outcome, ...], index: int
) -> Evaluation:
    """Join the outcomes of a point's experiments, which stand in their order.

    Parameters
    ----------
    space, x
        Where the point lies.
    outcomes
        One for each experiment of the space, with its priors.
    index
        The number of the point among all that its search has asked for.
    """
    if not all(outcome.ok for outcome in outcomes):
        return Evaluation(outcomes, np.nan, violation=np.nan, index=index)
    cost = space.problem.cost.value(joined_residuals(outcomes), space.outputs)
    if not space.constraint_names:
        return Evaluation(outcomes, cost, index=index)
    parts = [space.parameter_constraints(x), *(outcome.constraints for outcome in outcomes)]
    constraints = np.concatenate(parts)
    return Evaluation(outcomes, cost, constraints, violation(constraints, space.equality), index)


def with_priors(space: SearchSpace, x: FloatArray, e: int, outcome: Outcome) -> Outcome:
    """Return the outcome of an experiment with the residuals of the priors that count with it.

    They stand in no log and come from no worker: they follow from the point alone.
    """
    if not outcome.ok or not len(space.priors.places[e]):
        return outcome
    known = np.zeros(0) if outcome.residuals is None else outcome.residuals
    return replace(outcome, residuals=np.concatenate([known, space.priors.residuals(e, x)]))


def with_continuity(space: SearchSpace, x: FloatArray, e: int, outcome: Outcome) -> Outcome:
    """Return the outcome of a segment with the differences between its end and the next start."""
    if space.continuity is None or not outcome.ok or outcome.residuals is None:
        return outcome
    return replace(outcome, residuals=space.continuity.applied(e, x, outcome.residuals))


def violation(constraints: FloatArray, equality: npt.NDArray[np.bool_]) -> float:
    """The largest violation; 0 where all are satisfied, infinite where one has no value."""
    if np.isnan(constraints).any():
        return np.inf
    sizes = np.where(equality, np.abs(constraints), np.maximum(constraints, 0.0))
    return float(sizes.max(initial=0.0))


MEMORY_BYTES = 256 * 2**20
"""What is remembered to answer repeated questions without simulating."""
OUTCOME_BYTES = 800
"""What an outcome takes besides its residuals."""

Question = tuple[int, bytes, tuple[Effect, ...], Want, float]
"""Experiment, values and effects, which make a simulation, what is wanted of it, and the bound
above which it ends early: whole residuals never stand in for reduced ones, nor one bound for
another, or bits would depend on which of them came first."""


@dataclass(frozen=True)
class SearchRequest:
    """One search: a method let loose on a space.

    `name` tells searches apart in the log; `seed` starts the method's random generator.
    """

    name: str
    method: Method
    space: SearchSpace
    seed: int = 0


def suited(space: SearchSpace, method: Method) -> SearchSpace:
    """The space as a method is given it: reduced, unless it looks at single residuals."""
    return space if method.needs_every_residual else replace(space, reduced=True)


@dataclass
class PendingPoint:
    """A point that was asked for, and the outcomes that are there already."""

    index: int
    x: FloatArray
    outcomes: list[Outcome | None]
    missing: int


@dataclass
class SearchState:
    """A search in progress and the points that it waits for, by index."""

    request: SearchRequest
    steps: Search
    pending: dict[int, PendingPoint] = field(default_factory=dict)
    answers: list[tuple[Evaluation, FloatArray]] = field(default_factory=list)
    asynchronous: bool = False
    purpose: str = ""
    sensitivities: bool = False
    asked: int = 0
    requested: int = 0
    best: Evaluation | None = None
    best_x: FloatArray | None = None
    progress: Progress = field(default_factory=lambda: Progress(0, np.nan))
    solution: Solution | None = None
    counts: bool = True
    lines: list[SearchIteration] = field(default_factory=list)

    @property
    def ready(self) -> bool:
        """True where all that it waits for is there."""
        if self.asynchronous:
            return bool(self.answers) or not self.pending
        return not self.pending

    def expect(self, points: Points) -> int:
        """Wait for points from now on, and return the index of the first of them."""
        self.asynchronous, self.purpose = points.asynchronous, points.purpose
        self.sensitivities = points.sensitivities
        first, count = self.asked, len(self.request.space.experiments)
        self.asked += len(points.x)
        self.requested = len(points.x)
        for p, x in enumerate(points.x):
            self.pending[first + p] = PendingPoint(first + p, x.copy(), [None] * count, count)
        return first

    def place(self, index: int, e: int, outcome: Outcome) -> None:
        """Put an outcome where it is waited for; evaluate the point that it completes."""
        point = self.pending.get(index)
        if point is None:  # dropped, or the search has ended
            return
        space, x = self.request.space, point.x
        point.outcomes[e] = with_priors(space, x, e, with_continuity(space, x, e, outcome))
        point.missing -= 1
        if point.missing == 0:
            del self.pending[index]
            outcomes = tuple(o for o in point.outcomes if o is not None)
            self.answers.append((assemble_evaluation(space, x, outcomes, index), x))

    def take_answers(self) -> list[Evaluation]:
        """The evaluations that it is sent, in the order in which it asked for them."""
        answers = sorted(self.answers, key=lambda answer: answer[0].index)
        self.answers = []
        for evaluation, x in answers:
            if evaluation.ok and (self.best is None or evaluation.rank < self.best.rank):
                self.best, self.best_x = evaluation, x
        return [evaluation for evaluation, _ in answers]

    def cut_short(self, ending: Ending) -> None:
        """End with the best point so far, or with the start where there is none."""
        x = self.request.space.start if self.best_x is None else self.best_x
        cost = np.nan if self.best is None else self.best.cost
        self.solution = Solution(x, cost, ending, iterations=self.progress.iteration, at=self.best)
        self.pending.clear()

    def last_line(self) -> Progress | None:
        """Return how it ended, as a line of its table; None if it has not."""
        solution = self.solution
        if solution is None:
            return None
        violation = np.nan
        if self.request.space.constraint_names and solution.at is not None:
            violation = solution.at.violation
        return replace(
            self.progress,
            iteration=solution.iterations,
            cost=solution.cost,
            violation=violation,
            ending=solution.ending.name.lower(),
        )


class OutcomeCache:
    """Outcomes that answer a repeated question without simulating, up to a size."""

    def __init__(self) -> None:
        self._known: dict[Question, Outcome] = {}
        self._bytes = 0

    def get(self, question: Question) -> Outcome | None:
        return self._known.get(question)

    def remember(self, question: Question, outcome: Outcome) -> None:
        kept = (outcome.residuals, outcome.sensitivities)
        size = OUTCOME_BYTES + sum(0 if each is None else each.nbytes for each in kept)
        if self._bytes + size > MEMORY_BYTES:
            self._known.clear()
            self._bytes = 0
        self._known[question] = outcome
        self._bytes += size
