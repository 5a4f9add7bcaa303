"""Methods with populations: each generation is one request.

A `PopulationStrategy` chooses the next generation; most strategies are from pymoo. This module
compares members, keeps the best point, writes the lines of the table and ends the search. Points
are compared as in all methods: constraints first, then cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.method import (
    Ending,
    Evaluation,
    Method,
    OtherPoint,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import Unknown
from cluster_est.toml import dotted
from workers.messages import FloatArray

LARGEST_COST = 1e300
"""Largest finite cost and violation; larger values are clipped to it."""
COST_OF_FAILURE = 1e301
"""Cost and violation of a failed simulation: worse than any other, and finite, as pymoo needs."""


@dataclass(frozen=True)
class PopulationMember:
    """A point of a population.

    Attributes
    ----------
    unit, x : (unknowns,)
        The point in the strategy's coordinates, and in search coordinates.
    cost
        Cost of the point.
    values : (objectives,)
        Objectives that the strategy minimises.
    violation
        Violation of the constraints; 0 if all are satisfied.
    """

    unit: FloatArray
    x: FloatArray
    cost: float
    values: FloatArray
    violation: float

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, best first, as in `Evaluation.rank`."""
        return self.violation, self.cost


def member_of(
    unit: FloatArray, x: FloatArray, evaluation: Evaluation, goal: PopulationGoal
) -> PopulationMember:
    """Return the member of an evaluated point; a failed simulation is worse than any other."""
    if not evaluation.ok or np.isnan(evaluation.cost):
        return PopulationMember(
            unit, x, COST_OF_FAILURE, np.full(goal.objectives, COST_OF_FAILURE), COST_OF_FAILURE
        )
    values = np.fmax(
        np.fmin(goal.values(evaluation), LARGEST_COST), -LARGEST_COST
    )  # NaN becomes LARGEST_COST
    violation = min(evaluation.rank[0], LARGEST_COST)
    return PopulationMember(unit, x, evaluation.cost, values, violation)


class PopulationStrategy(ABC):
    """An algorithm that chooses a generation from the previous generations."""

    @abstractmethod
    def ask(self) -> FloatArray:
        """Return the next generation (points, unknowns); no points if there are no new points."""

    @abstractmethod
    def tell(self, numbers: range, members: Sequence[PopulationMember]) -> None:
        """Process the members of the generation; `numbers` are the numbers of their points."""

    @abstractmethod
    def bounds(self) -> FloatArray:
        """Return costs (points,) above which points of the current generation do not survive.

        A cost is infinite if survival depends on other new points. Call it only without
        constraints.
        """

    @abstractmethod
    def survivors(self) -> list[int]:
        """Return the numbers of the points in the current population."""


class PopulationGoal(ABC):
    """The objectives of a population, and the criterion for the end of the search."""

    objectives: int

    @abstractmethod
    def values(self, evaluation: Evaluation) -> FloatArray:
        """Return the objectives (objectives,) of an evaluation without failures."""

    @abstractmethod
    def settled(self, best: PopulationMember, members: Sequence[PopulationMember]) -> bool:
        """Return whether the last generations made no progress; call it once per generation."""

    @abstractmethod
    def others(
        self, best: PopulationMember, members: Sequence[PopulationMember]
    ) -> tuple[OtherPoint, ...]:
        """Return the other points of the solution."""


class LeastCost(PopulationGoal):
    """The least cost; settled if it falls by at most `ftol` of itself in `window` generations."""

    objectives = 1

    def __init__(self, ftol: float, window: int) -> None:
        self._ftol, self._window = ftol, window
        self._ranks: list[tuple[float, float]] = []

    @override
    def values(self, evaluation: Evaluation) -> FloatArray:
        return np.array([evaluation.cost])

    @override
    def settled(self, best: PopulationMember, members: Sequence[PopulationMember]) -> bool:
        self._ranks.append(best.rank)
        if len(self._ranks) <= self._window:
            return False
        pairs = zip(self._ranks[-1 - self._window], best.rank, strict=True)
        return all(before - now <= self._ftol * abs(now) for before, now in pairs)

    @override
    def others(
        self, best: PopulationMember, members: Sequence[PopulationMember]
    ) -> tuple[OtherPoint, ...]:
        return ()


@dataclass(frozen=True)
class UnitBox:
    """The coordinates of a strategy.

    The bounds of an unknown become 0 and 1. If a bound is missing, 0 is the start and 1 is the
    start plus the typical size.
    """

    space: SearchSpace

    @cached_property
    def bounded(self) -> npt.NDArray[np.bool_]:
        """True for unknowns with two finite bounds, (unknowns,)."""
        return np.isfinite(self.space.lower) & np.isfinite(self.space.upper)

    @cached_property
    def _origin(self) -> FloatArray:
        return np.where(self.bounded, self.space.lower, self.space.start)

    @cached_property
    def _scale(self) -> FloatArray:
        upper = np.where(self.bounded, self.space.upper, self.space.start + self.space.typical)
        return np.asarray(upper - self._origin, np.float64)

    @cached_property
    def start(self) -> FloatArray:
        return self._units(self.space.start)

    @cached_property
    def lower(self) -> FloatArray:
        return self._units(self.space.lower)

    @cached_property
    def upper(self) -> FloatArray:
        return np.where(self.bounded, 1.0, self._units(self.space.upper))

    def _units(self, x: FloatArray) -> FloatArray:
        return np.asarray((x - self._origin) / self._scale, np.float64)

    def points(self, units: FloatArray) -> FloatArray:
        """Return points in search coordinates, within bounds; the start is exact."""
        x = np.where(units == self.start, self.space.start, self._origin + units * self._scale)
        return np.clip(x, self.space.lower, self.space.upper)

    def first_generation(self, size: int, generator: np.random.Generator) -> FloatArray:
        """Return the start and a Latin hypercube between the bounds.

        M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239-245,
        doi:10.1080/00401706.1979.10489755.
        """
        count = size - 1
        cells = np.array([generator.permutation(count) for _ in range(self.space.size)]).T
        return np.vstack([self.start, (cells + generator.random(cells.shape)) / count])


@dataclass(frozen=True)
class PopulationMethod(Method):
    """Base class of methods that move many points at a time, one generation per request.

    The first generation is spread between the bounds, so every unknown must have two bounds.
    `cmaes` samples around the start instead, and needs no bounds.

    Attributes
    ----------
    population
        Number of points of a generation, which are all simulated at once. A larger population
        searches more widely and keeps more workers busy, but each generation costs more. 0 selects
        the method's default.
    max_generations
        Largest number of generations.
    xtol
        Converged when all points of the population lie this close together in every unknown, in
        units of the range between its bounds.
    ftol, window
        Converged when the best cost has fallen by no more than `ftol` of itself in the last
        `window` generations. Widen the window if a search ends too soon.
    """

    needs_residuals: ClassVar[bool] = False
    needs_every_residual: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True
    keeps_equality: ClassVar[bool] = False
    """True if the method supports equality constraints."""
    needs_bounds: ClassVar[bool] = True
    least_population: ClassVar[int] = 5
    early_end = False
    """True if a simulation may end as soon as its point cannot survive; some methods' option."""

    population: int = field(default=0, metadata={"least": 0})
    max_generations: int = field(default=500, metadata={"least": 1})
    xtol: float = field(default=1e-6, metadata={"least": 0.0})
    ftol: float = field(default=1e-8, metadata={"least": 0.0})
    window: int = field(default=30, metadata={"least": 1})

    @override
    def check(self, space: SearchSpace) -> None:
        if 0 < self.population < self.least_population:
            raise ProblemError(
                f"method.options.population: must be at least {self.least_population} for method "
                f'"{self.name}", but is {self.population}; raise it, or set 0 for the default size'
            )
        if space.equality.any() and not self.keeps_equality:
            name = space.constraint_names[int(np.argmax(space.equality))]
            raise ProblemError(
                f'constraints: must be inequalities for method "{self.name}", but {name!r} is an '
                'equality, which almost no point of a population satisfies; use method "isres", '
                '"sqp" or "least_squares", or define one parameter by an expression in the others'
            )
        if self.needs_bounds and not UnitBox(space).bounded.all():
            unknown = space.unknowns[int(np.argmin(UnitBox(space).bounded))]
            raise ProblemError(_unbounded(self.name, unknown))

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        self.check(space)
        return evolve(self, space, generator)

    @abstractmethod
    def usual_population(self, unknowns: int) -> int:
        """Return the number of points of a generation if `population` is 0."""

    @abstractmethod
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        """Return the strategy that chooses generations of this size."""

    def goal(self, space: SearchSpace) -> PopulationGoal:
        """Return the goal; the default is the least cost."""
        del space  # used by methods with several objectives
        return LeastCost(self.ftol, self.window)


def _unbounded(method: str, unknown: Unknown) -> str:
    p = unknown.parameter
    positive = " and positive, because its scale is logarithmic," if unknown.log else ""
    return (
        f"{dotted('parameters', p.name)}.bounds: must be finite on both sides{positive} for method "
        f'"{method}", which spreads its first points between them, but are [{p.lower:g}, '
        f"{p.upper:g}]; set both bounds, or use a method that needs no bounds"
    )


def evolve(method: PopulationMethod, space: SearchSpace, generator: np.random.Generator) -> Search:
    """Request generations until the method's tolerances or its limit end the search."""
    box, goal = UnitBox(space), method.goal(space)
    size = method.population or method.usual_population(space.size)
    strategy = method.strategy(box, size, goal, generator)
    alive: dict[int, PopulationMember] = {}
    best: _BestSoFar | None = None
    progress: Progress | None = None
    asked, generation = 0, 0
    units = strategy.ask()
    ends_early = method.early_end and not space.constraint_names
    while True:
        x = box.points(units)
        bounds = strategy.bounds() if ends_early else None
        evaluations = yield Points(x, "generation", progress, bounds=bounds)
        new_members = [member_of(*three, goal) for three in zip(units, x, evaluations, strict=True)]
        best = _better(best, new_members, evaluations)
        if best is None:
            reason = evaluations[0].reason or "the cost at the start is not a number"
            return Solution(space.start, np.nan, Ending.START_FAILED, reason)
        numbers = range(asked, asked + len(new_members))
        asked, generation = numbers.stop, generation + 1
        strategy.tell(numbers, new_members)
        alive.update(zip(numbers, new_members, strict=True))
        alive = {number: alive[number] for number in strategy.survivors()}
        members = list(alive.values())
        violation = best.member.violation if space.constraint_names else np.nan
        progress = Progress(generation, best.member.cost, _spread(members), violation=violation)
        units = strategy.ask()
        settled = goal.settled(best.member, members)
        ending = _ending(method, progress, settled, exhausted=not len(units))
        if ending is not None:
            others = goal.others(best.member, members)
            return _solution(best, *ending, iterations=generation, others=others)


@dataclass(frozen=True)
class _BestSoFar:
    """The best point of all generations; the current population may not contain it."""

    member: PopulationMember
    at: Evaluation


def _better(
    best: _BestSoFar | None,
    new_members: Sequence[PopulationMember],
    evaluations: Sequence[Evaluation],
) -> _BestSoFar | None:
    """Return the best point so far; None if all points have failed."""
    for member, evaluation in zip(new_members, evaluations, strict=True):
        if member.violation < COST_OF_FAILURE and (best is None or member.rank < best.member.rank):
            best = _BestSoFar(member, evaluation)
    return best


def _spread(members: Sequence[PopulationMember]) -> float:
    """Return the largest width of a population in any unknown."""
    units = np.array([member.unit for member in members])
    return float(np.max(np.ptp(units, axis=0), initial=0.0))


def _ending(
    method: PopulationMethod, progress: Progress, settled: bool, exhausted: bool
) -> tuple[Ending, str] | None:
    """Return the ending of a search and its message; None if it goes on."""
    if progress.step <= method.xtol:
        return Ending.CONVERGED, "converged: the population has contracted to within xtol"
    if settled:
        no_progress = f"the last {method.window} generations lowered the cost by no more than ftol"
        return Ending.CONVERGED, f"converged: {no_progress}"
    if progress.iteration >= method.max_generations:
        ended = f"stopped after {method.max_generations} generations"
        return Ending.MAX_ITERATIONS, f"{ended}; raise method.options.max_generations"
    if exhausted:
        return Ending.STALLED, "the population produces no new points"
    return None


def _solution(
    best: _BestSoFar, ending: Ending, message: str, iterations: int, others: tuple[OtherPoint, ...]
) -> Solution:
    x, cost, violation = best.member.x, best.member.cost, best.member.violation
    if violation > 0.0:
        message = f"{Ending.INFEASIBLE}; the best point violates them by {violation:.2g}; {message}"
        ending = Ending.INFEASIBLE
    return Solution(x, cost, ending, message, iterations, at=best.at, others=others)
