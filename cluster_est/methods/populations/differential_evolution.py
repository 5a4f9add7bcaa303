"""Differential evolution, by pymoo.

R. Storn, K. Price, J. Global Optim. 11 (1997) 341-359, doi:10.1023/A:1008202821328.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from typing_extensions import override

from cluster_est.methods.populations.generation import PopulationGoal, PopulationStrategy, UnitBox
from cluster_est.methods.populations.method import PopulationMethod
from cluster_est.methods.populations.pymoo_strategy import PymooStrategy


@dataclass(frozen=True)
class DifferentialEvolution(PopulationMethod):
    """Each point steps by the difference of two others, and stays where that does not help.

    The population to try first where several minima are likely and all unknowns have bounds. It
    keeps inequality constraints, unless only a sliver between the bounds satisfies them. It needs
    thousands of simulations: with a single minimum `least_squares` needs a hundredth of them.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        Of every `PopulationMethod`. The usual population is 10 points per unknown, at least 30:
        with fewer, the differences soon take only few values. Between several minima the best cost
        may stand still for long, so the window is wide.
    base
        The point where steps begin: "rand" at any point of the population, which searches most
        widely; "best" at its best point, which is faster and more easily caught in a local minimum.
    weight
        Of the differences. Raise it if the population shrinks too early.
    crossover
        Part of the unknowns that move in a step. Lower it (0.2) if unknowns act independently.
    early_end
        End the simulation of a point as soon as the part of its cost that is known is above what
        it would have to be below to stay in the population. The result is the same, bit for bit;
        where simulations take seconds, half of their time may be saved. It takes effect with the
        sum of squares and without constraints and effects.
    """

    name: ClassVar[str] = "de"

    window: int = field(default=60, metadata={"least": 1})
    base: Literal["rand", "best"] = "rand"
    weight: float = field(default=0.6, metadata={"least": 0.0})
    crossover: float = field(default=0.9, metadata={"least": 0.0})
    early_end: bool = False

    @override
    def usual_population(self, unknowns: int) -> int:
        return max(30, 10 * unknowns)

    @override
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        from pymoo.algorithms.soo.nonconvex.de import DE

        return PymooStrategy(
            DE,
            box,
            size,
            goal,
            generator,
            rivals="member",
            pop_size=size,
            variant=f"DE/{self.base}/1/bin",
            F=self.weight,
            CR=self.crossover,
            prob_mut=0.0,
        )
