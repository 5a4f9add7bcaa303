"""Evolutionary methods for one objective, with algorithms of pymoo.

J. Blank, K. Deb, IEEE Access 8 (2020) 89497-89509, doi:10.1109/ACCESS.2020.2990567.

The import of pymoo is slow, so it is imported only for a search.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from typing_extensions import override

from cluster_est.methods.populations.population_method import (
    PopulationGoal,
    PopulationMember,
    PopulationMethod,
    PopulationStrategy,
    UnitBox,
)
from workers.messages import FloatArray

Rivals = Literal["member", "worst"] | None


class PymooStrategy(PopulationStrategy):
    """An algorithm of pymoo that takes all random numbers from one generator.

    With constraints, their violation is pymoo's only constraint. So pymoo ranks points as all
    methods do.

    Parameters
    ----------
    method
        The method that provides the algorithm.
    box, size, goal, generator
        As in `PopulationMethod.strategy`.
    """

    def __init__(
        self,
        method: PymooMethod,
        box: UnitBox,
        size: int,
        goal: PopulationGoal,
        generator: np.random.Generator,
    ) -> None:
        from pymoo.config import Config
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        Config.warnings["not_compiled"] = False  # pymoo would print this warning
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
        kind, options = method.algorithm(size)
        # pymoo uses a generator that is given as a seed
        self._algorithm = kind(sampling=first, seed=generator, **options)
        self._algorithm.setup(problem, termination=NoTermination())
        if getattr(self._algorithm, "survival", None) is not None:
            self._algorithm.survival = _SeededSurvival(self._algorithm.survival, generator)
        self._asked: Any = None
        self._rivals = method.rivals

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
    """A selection of survivors with random numbers from a generator.

    By default pymoo seeds it from the system, so the stochastic ranking of `isres` would not be
    reproducible.
    """

    def __init__(self, survival: Any, generator: np.random.Generator) -> None:
        self._survival, self._generator = survival, generator

    def do(self, *args: Any, **options: Any) -> Any:
        return self._survival.do(*args, **{**options, "random_state": self._generator})


@dataclass(frozen=True)
class PymooMethod(PopulationMethod):
    """Base class of population methods with an algorithm of pymoo."""

    rivals: ClassVar[Rivals] = None
    """The member that a new point must beat to survive.

    "member" is the member that the point would replace, "worst" the worst of the population. None
    if survival depends on other new points."""

    @abstractmethod
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        """Return the class of the algorithm, and its arguments for generations of a size.

        The arguments exclude the first generation and the seed.
        """

    @override
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        return PymooStrategy(self, box, size, goal, generator)


@dataclass(frozen=True)
class DifferentialEvolution(PymooMethod):
    """Differential evolution: points step by the difference of two others if that lowers the cost.

    Among the population methods, try it first if several minima are likely and all unknowns have
    bounds. It supports inequality constraints, unless the feasible region is very small. It needs
    thousands of simulations. For a single minimum, `least_squares` needs a hundredth of them.

    R. Storn, K. Price, J. Global Optim. 11 (1997) 341-359, doi:10.1023/A:1008202821328.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        As in every `PopulationMethod`. The default population is 10 points per unknown, at least
        30: a smaller population soon has too few different differences. The window is wide, because
        with several minima the best cost may stay constant for a long time.
    base
        The point at which steps begin. "rand": any point of the population; the widest search.
        "best": the best point; faster, but ends in a local minimum more often.
    weight
        Factor of the differences. Raise it if the population shrinks too early.
    crossover
        Part of the unknowns that move in a step. Lower it (0.2) if unknowns act independently.
    early_end
        End the simulation of a point as soon as the known part of its cost is too large to stay in
        the population. The result is the same, bit for bit. If simulations take seconds, this may
        save half of their time. It takes effect with the sum of squares and without constraints and
        effects.
    """

    name: ClassVar[str] = "de"
    rivals: ClassVar[Rivals] = "member"

    window: int = field(default=60, metadata={"least": 1})
    base: Literal["rand", "best"] = "rand"
    weight: float = field(default=0.6, metadata={"least": 0.0})
    crossover: float = field(default=0.9, metadata={"least": 0.0})
    early_end: bool = False

    @override
    def usual_population(self, unknowns: int) -> int:
        return max(30, 10 * unknowns)

    @override
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        from pymoo.algorithms.soo.nonconvex.de import DE

        return DE, {
            "pop_size": size,
            "variant": f"DE/{self.base}/1/bin",
            "F": self.weight,
            "CR": self.crossover,
            "prob_mut": 0.0,
        }


@dataclass(frozen=True)
class GeneticAlgorithm(PymooMethod):
    """Genetic algorithm: children combine two parents and mutate; the best points survive.

    Use it for costs with jumps, or if good values of single unknowns can be combined. It locates
    the region of a minimum with low accuracy; continue with another method. If `de` works, `de`
    needs fewer simulations.

    Simulated binary crossover of K. Deb, R. B. Agrawal, Complex Systems 9 (1995) 115-148, and
    polynomial mutation; constraints by the rules of K. Deb, Comput. Methods Appl. Mech. Engrg. 186
    (2000) 311-338, doi:10.1016/S0045-7825(99)00389-8.

    Attributes
    ----------
    population, max_generations, window
        As in every `PopulationMethod`. The default population is 10 points per unknown, at least
        50.
    xtol, ftol
        As in every `PopulationMethod`, with other defaults. The population contracts long before
        it is at a minimum, and mutations still improve it then. So the default of `xtol` is 0,
        which disables this criterion in practice. The larger `ftol` ends the search sooner.
    crossover_eta, mutation_eta
        Similarity of children to their parents, and of a mutated value to the previous value.
        Larger numbers make the search finer and narrower.
    crossover_probability
        Part of the pairs of parents that are combined.
    early_end
        As in `de`.
    """

    name: ClassVar[str] = "ga"
    rivals: ClassVar[Rivals] = "worst"

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
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM

        return GA, {
            "pop_size": size,
            "crossover": SBX(prob=self.crossover_probability, eta=self.crossover_eta),
            "mutation": PM(eta=self.mutation_eta),
        }


@dataclass(frozen=True)
class Isres(PymooMethod):
    """Evolution strategy that sometimes prefers a low cost to satisfied constraints.

    Use it for minima on nonlinear constraints, especially if the feasible region is narrow or
    disconnected. It is the only population method that supports equalities. Without constraints
    `de` and `cmaes` need fewer simulations.

    T. P. Runarsson, X. Yao, IEEE Trans. SMC C 35 (2005) 233-243, doi:10.1109/TSMCC.2004.841906,
    with the ranking of T. P. Runarsson, X. Yao, IEEE Trans. Evol. Comput. 4 (2000) 284-294,
    doi:10.1109/4235.873238.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        As in every `PopulationMethod`. The default population is 20 (unknowns + 1) points; every
        seventh becomes a parent. The window is wide, because the best point may be lost for some
        generations.
    ranking
        Probability that two points are ranked by cost although one violates a constraint. At 0,
        constraints always come first. Above 0.5, the cost dominates.
    gamma
        Length of the steps along the differences of the best points.
    alpha
        Rate of change of the step lengths: 0.2 smooths random variations.
    """

    name: ClassVar[str] = "isres"
    keeps_equality: ClassVar[bool] = True
    least_population: ClassVar[int] = 14

    window: int = field(default=100, metadata={"least": 1})
    ranking: float = field(default=0.45, metadata={"least": 0.0})
    gamma: float = field(default=0.85, metadata={"least": 0.0})
    alpha: float = field(default=0.2, metadata={"least": 1e-6})

    @override
    def usual_population(self, unknowns: int) -> int:
        return 20 * (unknowns + 1)

    @override
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        from pymoo.algorithms.soo.nonconvex.isres import ISRES

        return ISRES, {
            "n_offsprings": size,
            "PF": self.ranking,
            "gamma": self.gamma,
            "alpha": self.alpha,
        }


@dataclass(frozen=True)
class ParticleSwarm(PymooMethod):
    """Particle swarm: points move towards their own best point and the best point of all.

    Use it to explore a wide region with a small population. It converges slowly near a minimum;
    `de` and `cmaes` converge faster.

    J. Kennedy, R. Eberhart, Proc. ICNN (1995) 1942-1948, doi:10.1109/ICNN.1995.488968, with the
    weights of M. Clerc, J. Kennedy, IEEE Trans. Evol. Comput. 6 (2002) 58-73,
    doi:10.1109/4235.985692, or the adaptation of Z. Zhan, J. Zhang, Y. Li, H. Chung, IEEE Trans.
    SMC B 39 (2009) 1362-1381, doi:10.1109/TSMCB.2009.2015956.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        As in every `PopulationMethod`. The default population is 5 points per unknown, at least 25.
        The population consists of each particle's best point. These points are rarely as close
        together as `xtol`.
    inertia, own, social
        Part of its velocity that a particle keeps, and weights of its own best point and of the
        swarm's best point. Below 0.73, 1.5, 1.5 the swarm converges sooner; above, it may never
        converge.
    adaptive
        Adapt inertia, own and social to the state of the swarm, beginning with 0.9, 2, 2. The
        search needs fewer generations near a minimum, but ends in a local minimum more often.
    speed
        Largest velocity: the part of the range between the bounds that a particle may cross in one
        generation.
    early_end
        As in `de`.
    """

    name: ClassVar[str] = "pso"
    rivals: ClassVar[Rivals] = "member"

    window: int = field(default=50, metadata={"least": 1})
    inertia: float = field(default=0.73, metadata={"least": 0.0})
    own: float = field(default=1.5, metadata={"least": 0.0})
    social: float = field(default=1.5, metadata={"least": 0.0})
    adaptive: bool = False
    speed: float = field(default=0.2, metadata={"least": 0.0})
    early_end: bool = False

    @override
    def usual_population(self, unknowns: int) -> int:
        return max(25, 5 * unknowns)

    @override
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        from pymoo.algorithms.soo.nonconvex.pso import PSO

        inertia, own, social = self.inertia, self.own, self.social
        if self.adaptive:
            inertia, own, social = 0.9, 2.0, 2.0
        return PSO, {
            "pop_size": size,
            "w": inertia,
            "c1": own,
            "c2": social,
            "adaptive": self.adaptive,
            "max_velocity_rate": self.speed,
        }
