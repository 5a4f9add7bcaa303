"""A genetic algorithm for real numbers, by pymoo.

Simulated binary crossover of K. Deb, R. B. Agrawal, Complex Systems 9 (1995) 115-148, and
polynomial mutation; constraints by the rules of K. Deb, Comput. Methods Appl. Mech. Engrg. 186
(2000) 311-338, doi:10.1016/S0045-7825(99)00389-8.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.populations.generation import PopulationGoal, PopulationStrategy, UnitBox
from cluster_est.methods.populations.method import PopulationMethod
from cluster_est.methods.populations.pymoo_strategy import PymooStrategy


@dataclass(frozen=True)
class GeneticAlgorithm(PopulationMethod):
    """The fittest of parents and children live on; children mix two parents and mutate.

    For costs that jump, or where good values of single unknowns can be combined. It finds the
    region of a minimum but few digits of it: go on from there with another method. Where `de`
    works, it needs fewer simulations.

    Attributes
    ----------
    population, max_generations, window
        Of every `PopulationMethod`. The usual population is 10 points per unknown, at least 50.
    xtol, ftol
        Likewise, but a population of kin draws together long before it is at a minimum, from where
        mutations still lead on. So nearness counts only where `xtol` is raised from 0, and a cost
        that hardly falls ends the search sooner.
    crossover_eta, mutation_eta
        Resemblance of children to their parents, and of a mutated value to the one before: more
        with larger numbers, so that the search is finer and less wide.
    crossover_probability
        Part of the pairs of parents that mix.
    early_end
        As in `de`.
    """

    name: ClassVar[str] = "ga"

    xtol: float = field(default=0.0, metadata={"least": 0.0})
    ftol: float = field(default=1e-4, metadata={"least": 0.0})
    crossover_eta: float = field(default=3.0, metadata={"least": 1.0})
    mutation_eta: float = field(default=20.0, metadata={"least": 1.0})
    crossover_probability: float = field(default=0.9, metadata={"least": 0.0})
    early_end: bool = False

    @override
    def usual_population(self, unknowns: int) -> int:
        return max(50, 10 * unknowns)

    @override
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM

        return PymooStrategy(
            GA,
            box,
            size,
            goal,
            generator,
            rivals="worst",
            pop_size=size,
            crossover=SBX(prob=self.crossover_probability, eta=self.crossover_eta),
            mutation=PM(eta=self.mutation_eta),
        )
