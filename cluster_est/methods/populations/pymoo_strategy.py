"""Algorithms of pymoo as strategies, driven by asking and telling.

J. Blank, K. Deb, IEEE Access 8 (2020) 89497-89509, doi:10.1109/ACCESS.2020.2990567.

pymoo takes long to import, so only a search imports it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from cluster_est.methods.populations.generation import (
    PopulationGoal,
    PopulationMember,
    PopulationStrategy,
    UnitBox,
)
from workers.messages import FloatArray


class PymooStrategy(PopulationStrategy):
    """An algorithm of pymoo whose random numbers all come from a generator.

    Where there are constraints, their violation is pymoo's only constraint, so that it ranks points
    as all methods do.

    Parameters
    ----------
    kind, options
        Class of the algorithm, and what it is made with besides its first generation and seed.
    box, size, goal, generator
        As in `PopulationMethod.strategy`.
    rivals
        Whom a new point must be better than to survive: the one "member" in whose place it would
        come, or the "worst" of the population; None where it depends on other new points.
    """

    def __init__(
        self,
        kind: Any,
        box: UnitBox,
        size: int,
        goal: PopulationGoal,
        generator: np.random.Generator,
        rivals: Literal["member", "worst"] | None = None,
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
            self._algorithm.survival = _SeededSurvival(self._algorithm.survival, generator)
        self._asked: Any = None
        self._rivals = rivals

    def ask(self) -> FloatArray:
        self._asked = self._algorithm.ask()
        if self._asked is None:
            return np.zeros((0, 0))
        return np.asarray(self._asked.get("X"), np.float64)

    def tell(self, numbers: range, members: Sequence[PopulationMember]) -> None:
        self._asked.set("number", list(numbers))
        self._asked.set("F", np.array([member.values for member in members]))
        if self._constrained:
            self._asked.set("G", np.array([[member.violation] for member in members]))
        self._algorithm.tell(infills=self._asked)

    def bounds(self) -> FloatArray:
        asked, alive = len(self._asked), self._algorithm.pop
        if self._rivals is None or alive is None or not len(alive) or not alive.has("number"):
            return np.full(asked, np.inf)
        costs = np.asarray(alive.get("F"), np.float64)[:, 0]
        return costs if self._rivals == "member" else np.full(asked, np.max(costs))

    def survivors(self) -> list[int]:
        return [int(number) for number in self._algorithm.pop.get("number")]


class _SeededSurvival:
    """A choice of survivors with random numbers from a generator; pymoo's takes the system's.

    That would make the stochastic ranking of `isres` different each time.
    """

    def __init__(self, survival: Any, generator: np.random.Generator) -> None:
        self._survival, self._generator = survival, generator

    def do(self, *args: Any, **options: Any) -> Any:
        return self._survival.do(*args, **{**options, "random_state": self._generator})
