"""Members of a population, strategies that choose generations, and goals.

Points are compared by the rules that hold for all methods: constraints first, then cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from cluster_est.methods.base import Evaluation, OtherPoint
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
