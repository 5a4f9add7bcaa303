"""Populations as methods: a whole generation is one request.

What picks the next generation is a `Strategy`, most of them from pymoo (J. Blank, K. Deb, IEEE
Access 8 (2020) 89497-89509, doi:10.1109/ACCESS.2020.2990567). It sees coordinates of order one and
compares points by the rules that hold for all methods: constraints first, then cost. What comes
after a generation is decided here: the best point so far, the lines of the table, when to stop.

pymoo takes long to import, so only a search imports it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import (
    Ending,
    Evaluation,
    Method,
    Other,
    Points,
    Progress,
    Search,
    Solution,
)
from cluster_est.space import Space, Unknown
from workers.messages import FloatArray

LARGEST = 1e300
"""Costs and violations are cut to this, to stay finite."""
FAILED = 1e301
"""Cost and violation of a failed simulation: worse than any other, and finite, as pymoo needs."""


@dataclass(frozen=True)
class Member:
    """A point of a population.

    Attributes
    ----------
    unit, x : (unknowns,)
        In the strategy's coordinates and in those of the search.
    cost
        Of the point.
    values : (objectives,)
        What the strategy minimises.
    violation
        0 where all constraints are satisfied.
    """

    unit: FloatArray
    x: FloatArray
    cost: float
    values: FloatArray
    violation: float

    @property
    def rank(self) -> tuple[float, float]:
        """Less is better, in the order of `Evaluation.rank`."""
        return self.violation, self.cost


class Strategy(ABC):
    """What picks a generation from those before it."""

    @abstractmethod
    def ask(self) -> FloatArray:
        """(points, unknowns): the next generation; no points if it can make no new ones."""

    @abstractmethod
    def tell(self, numbers: range, members: Sequence[Member]) -> None:
        """Take what became of the generation, whose points have these numbers."""

    @abstractmethod
    def survivors(self) -> list[int]:
        """The numbers of the points that make up the population now."""


class Goal(ABC):
    """What a population is after."""

    objectives: int

    @abstractmethod
    def values(self, evaluation: Evaluation) -> FloatArray:
        """(objectives,): what is minimised, of an evaluation without failures."""

    @abstractmethod
    def settled(self, best: Member, members: Sequence[Member]) -> bool:
        """Whether the last generations brought nothing; asked once after each."""

    @abstractmethod
    def others(self, best: Member, members: Sequence[Member]) -> tuple[Other, ...]:
        """What the solution shall name besides the best point."""


class LeastCost(Goal):
    """The least cost, until it falls by less than `ftol` of itself in `window` generations."""

    objectives = 1

    def __init__(self, ftol: float, window: int) -> None:
        self._ftol, self._window = ftol, window
        self._ranks: list[tuple[float, float]] = []

    def values(self, evaluation: Evaluation) -> FloatArray:
        return np.array([evaluation.cost])

    def settled(self, best: Member, members: Sequence[Member]) -> bool:
        self._ranks.append(best.rank)
        if len(self._ranks) <= self._window:
            return False
        pairs = zip(self._ranks[-1 - self._window], best.rank, strict=True)
        return all(before - now <= self._ftol * abs(now) for before, now in pairs)

    def others(self, best: Member, members: Sequence[Member]) -> tuple[Other, ...]:
        return ()


@dataclass(frozen=True)
class Box:
    """The coordinates of a strategy.

    The bounds of an unknown become 0 and 1. Where it lacks one, 0 is its start and 1 is as far
    from that as its typical size.
    """

    space: Space

    @cached_property
    def bounded(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
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
        """In search coordinates, within the bounds; the start comes back as it was given."""
        x = np.where(units == self.start, self.space.start, self._origin + units * self._scale)
        return np.clip(x, self.space.lower, self.space.upper)

    def first_generation(self, size: int, generator: np.random.Generator) -> FloatArray:
        """The start and a Latin hypercube between the bounds.

        M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239-245,
        doi:10.1080/00401706.1979.10489755.
        """
        count = size - 1
        cells = np.array([generator.permutation(count) for _ in range(self.space.size)]).T
        return np.vstack([self.start, (cells + generator.random(cells.shape)) / count])


@dataclass(frozen=True)
class PopulationMethod(Method):
    """A method that moves many points at a time, a generation for each request.

    Attributes
    ----------
    population
        Points of a generation, all simulated at once. More of them search more widely and keep
        more workers busy, but each generation costs more. 0 takes the method's own rule.
    generations
        Limit on their number.
    xtol
        Converged when all points of the population lie this close together in every unknown, in
        units of the range between its bounds.
    ftol, window
        Converged when the best cost has fallen by no more than `ftol` of itself in the last
        `window` generations. Widen the window if a search ends too soon.
    """

    needs_residuals: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True
    keeps_equality: ClassVar[bool] = False
    """Whether it gets anywhere along a constraint that must be 0."""
    needs_bounds: ClassVar[bool] = True
    least_population: ClassVar[int] = 5

    population: int = field(default=0, metadata={"least": 0})
    generations: int = field(default=500, metadata={"least": 1})
    xtol: float = field(default=1e-6, metadata={"least": 0.0})
    ftol: float = field(default=1e-8, metadata={"least": 0.0})
    window: int = field(default=30, metadata={"least": 1})

    def check(self, space: Space) -> None:
        if 0 < self.population < self.least_population:
            raise ProblemError(
                f"method.options.population: must be at least {self.least_population} for method "
                f'"{self.name}" but is {self.population}; raise it, or set 0 for the usual size'
            )
        if space.equality.any() and not self.keeps_equality:
            name = space.constraint_names[int(np.argmax(space.equality))]
            raise ProblemError(
                f'constraints: must be inequalities for method "{self.name}", but {name!r} is an '
                'equality, along which hardly any point of a population lies; use method "isres", '
                '"sqp" or "least_squares", or let a parameter follow from others by an expression'
            )
        if self.needs_bounds and not Box(space).bounded.all():
            unknown = space.unknowns[int(np.argmin(Box(space).bounded))]
            raise ProblemError(_unbounded(self.name, unknown))

    def search(self, space: Space, generator: np.random.Generator) -> Search:
        self.check(space)
        return evolve(self, space, generator)

    @abstractmethod
    def usual_population(self, unknowns: int) -> int:
        """Points of a generation where `population` is 0."""

    @abstractmethod
    def strategy(self, box: Box, size: int, goal: Goal, generator: np.random.Generator) -> Strategy:
        """What picks generations of this size."""

    def goal(self, space: Space) -> Goal:
        """What it is after: the least cost, unless a method says otherwise."""
        return LeastCost(self.ftol, self.window)


def _unbounded(method: str, unknown: Unknown) -> str:
    p = unknown.parameter
    positive = " and positive, as its scale is logarithmic," if unknown.log else ""
    return (
        f"parameters.{p.name}.bounds: must be finite on both sides{positive} for method "
        f'"{method}", which spreads its first points between them, but are '
        f"[{p.lower:g}, {p.upper:g}]; set both, or use a method that needs none"
    )


def evolve(method: PopulationMethod, space: Space, generator: np.random.Generator) -> Search:
    """Ask for one generation after the other until a method's tolerances or limit end it."""
    box, goal = Box(space), method.goal(space)
    size = method.population or method.usual_population(space.size)
    strategy = method.strategy(box, size, goal, generator)
    alive: dict[int, Member] = {}
    best: _Best | None = None
    progress: Progress | None = None
    asked, generation = 0, 0
    units = strategy.ask()
    while True:
        x = box.points(units)
        evaluations = yield Points(x, "generation", progress)
        born = [_member(*three, goal) for three in zip(units, x, evaluations, strict=True)]
        best = _better(best, born, evaluations)
        if best is None:
            reason = evaluations[0].reason or "the cost of the start is not a number"
            return Solution(space.start, np.nan, Ending.START_FAILED, reason)
        numbers = range(asked, asked + len(born))
        asked, generation = numbers.stop, generation + 1
        strategy.tell(numbers, born)
        alive.update(zip(numbers, born, strict=True))
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
class _Best:
    """The best point that was ever seen, which a population may have lost."""

    member: Member
    at: Evaluation


def _better(
    best: _Best | None, born: Sequence[Member], evaluations: Sequence[Evaluation]
) -> _Best | None:
    """The best of a generation and all before; None while all have failed."""
    for member, evaluation in zip(born, evaluations, strict=True):
        if member.violation < FAILED and (best is None or member.rank < best.member.rank):
            best = _Best(member, evaluation)
    return best


def _spread(members: Sequence[Member]) -> float:
    """How far apart a population is, in the unknown where it is widest."""
    units = np.array([member.unit for member in members])
    return float(np.max(np.ptp(units, axis=0), initial=0.0))


def _ending(
    method: PopulationMethod, progress: Progress, settled: bool, exhausted: bool
) -> tuple[Ending, str] | None:
    """Why a search is over, if it is."""
    if progress.step <= method.xtol:
        return Ending.CONVERGED, "converged: the population has drawn together to within xtol"
    if settled:
        gained = f"the last {method.window} generations gained no more than ftol"
        return Ending.CONVERGED, f"converged: {gained}"
    if progress.iteration >= method.generations:
        ended = f"stopped after {method.generations} generations"
        return Ending.MAX_ITERATIONS, f"{ended}; raise method.options.generations"
    if exhausted:
        return Ending.STALLED, "the population makes no new points any more"
    return None


def _solution(
    best: _Best, ending: Ending, message: str, iterations: int, others: tuple[Other, ...]
) -> Solution:
    x, cost, violation = best.member.x, best.member.cost, best.member.violation
    if violation > 0.0:
        message = f"{Ending.INFEASIBLE}, the best violates them by {violation:.2g}; {message}"
        ending = Ending.INFEASIBLE
    return Solution(x, cost, ending, message, iterations, at=best.at, others=others)


def _member(unit: FloatArray, x: FloatArray, evaluation: Evaluation, goal: Goal) -> Member:
    if not evaluation.ok or np.isnan(evaluation.cost):
        return Member(unit, x, FAILED, np.full(goal.objectives, FAILED), FAILED)
    values = np.nan_to_num(goal.values(evaluation), nan=LARGEST)
    violation = min(evaluation.rank[0], LARGEST)
    return Member(unit, x, evaluation.cost, np.clip(values, -LARGEST, LARGEST), violation)


class PymooStrategy(Strategy):
    """An algorithm of pymoo that takes all its chance from a generator.

    Where there are constraints, their violation is pymoo's only constraint, so that it ranks points
    as everything here does.

    Parameters
    ----------
    kind, options
        Class of the algorithm, and what it is made with besides its first generation and seed.
    box, size, goal, generator
        As in `PopulationMethod.strategy`.
    """

    def __init__(
        self,
        kind: Any,
        box: Box,
        size: int,
        goal: Goal,
        generator: np.random.Generator,
        **options: Any,
    ) -> None:
        from pymoo.config import Config
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        Config.warnings["not_compiled"] = False  # it would be printed
        unknowns = box.space.size
        self._constrained = bool(box.space.constraint_names)
        problem = Problem(
            n_var=unknowns,
            n_obj=goal.objectives,
            n_ieq_constr=int(self._constrained),
            xl=np.zeros(unknowns),
            xu=np.ones(unknowns),
        )
        first = box.first_generation(size, generator)
        # as a seed, a generator is used as it is
        self._algorithm = kind(sampling=first, seed=generator, **options)
        self._algorithm.setup(problem, termination=NoTermination())
        if getattr(self._algorithm, "survival", None) is not None:
            self._algorithm.survival = _Seeded(self._algorithm.survival, generator)
        self._asked: Any = None

    def ask(self) -> FloatArray:
        self._asked = self._algorithm.ask()
        if self._asked is None:
            return np.zeros((0, 0))
        return np.asarray(self._asked.get("X"), np.float64)

    def tell(self, numbers: range, members: Sequence[Member]) -> None:
        self._asked.set("number", list(numbers))
        self._asked.set("F", np.array([member.values for member in members]))
        if self._constrained:
            self._asked.set("G", np.array([[member.violation] for member in members]))
        self._algorithm.tell(infills=self._asked)

    def survivors(self) -> list[int]:
        return [int(number) for number in self._algorithm.pop.get("number")]


class _Seeded:
    """A choice of survivors that never takes chance from the system, as pymoo's does if not told.

    That would make the stochastic ranking of `isres` different each time.
    """

    def __init__(self, survival: Any, generator: np.random.Generator) -> None:
        self._survival, self._generator = survival, generator

    def do(self, *args: Any, **options: Any) -> Any:
        return self._survival.do(*args, **{**options, "random_state": self._generator})
