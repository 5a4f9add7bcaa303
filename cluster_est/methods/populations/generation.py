"""Members of a population, strategies that choose generations, and goals.

Points are compared by the rules that hold for all methods: constraints first, then cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from cluster_est.methods.base import Evaluation, OtherPoint
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray

LARGEST = 1e300
"""Costs and violations are cut to this, to stay finite."""
FAILED = 1e301
"""Cost and violation of a failed simulation: worse than any other, and finite, as pymoo needs."""


@dataclass(frozen=True)
class PopulationMember:
    """A point of a population.

    Attributes
    ----------
    unit, x : (unknowns,)
        In the strategy's coordinates and in those of the search.
    cost
        Of the point.
    values : (objectives,)
        Minimised by the strategy.
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


def member_of(
    unit: FloatArray, x: FloatArray, evaluation: Evaluation, goal: PopulationGoal
) -> PopulationMember:
    """Return the member of an evaluated point; a failed simulation is worse than any other."""
    if not evaluation.ok or np.isnan(evaluation.cost):
        return PopulationMember(unit, x, FAILED, np.full(goal.objectives, FAILED), FAILED)
    values = np.fmax(np.fmin(goal.values(evaluation), LARGEST), -LARGEST)  # NaN counts as LARGEST
    violation = min(evaluation.rank[0], LARGEST)
    return PopulationMember(unit, x, evaluation.cost, values, violation)


class PopulationStrategy(ABC):
    """An algorithm that chooses a generation from those before it."""

    @abstractmethod
    def ask(self) -> FloatArray:
        """Return the next generation (points, unknowns); no points if it can make no new ones."""

    @abstractmethod
    def tell(self, numbers: range, members: Sequence[PopulationMember]) -> None:
        """Take the members of the generation, whose points have these numbers."""

    @abstractmethod
    def bounds(self) -> FloatArray:
        """Return costs (points,) above which points of the generation asked for do not survive.

        Infinite where that depends on the other points. Only without constraints.
        """

    @abstractmethod
    def survivors(self) -> list[int]:
        """Return the numbers of the points that make up the population now."""


class PopulationGoal(ABC):
    """The objectives of a population, and when it has reached them."""

    objectives: int

    @abstractmethod
    def values(self, evaluation: Evaluation) -> FloatArray:
        """Return the objectives (objectives,) of an evaluation without failures."""

    @abstractmethod
    def settled(self, best: PopulationMember, members: Sequence[PopulationMember]) -> bool:
        """Return whether the last generations brought no progress; called once after each."""

    @abstractmethod
    def others(
        self, best: PopulationMember, members: Sequence[PopulationMember]
    ) -> tuple[OtherPoint, ...]:
        """Return the other points of the solution."""


class LeastCost(PopulationGoal):
    """The least cost, until it falls by less than `ftol` of itself in `window` generations."""

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

    The bounds of an unknown become 0 and 1. Where it lacks one, 0 is its start and 1 is as far
    from that as its typical size.
    """

    space: SearchSpace

    @cached_property
    def bounded(self) -> npt.NDArray[np.bool_]:
        """(unknowns,): True where both bounds are finite."""
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
        """Return points in search coordinates, within bounds; the start as it was given."""
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
