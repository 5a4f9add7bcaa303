"""Evolutionary methods for one objective, by pymoo: its algorithms are asked for points and told.

J. Blank, K. Deb, IEEE Access 8 (2020) 89497-89509, doi:10.1109/ACCESS.2020.2990567.

pymoo takes long to import, so only a search imports it.
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
    """An algorithm of pymoo whose random numbers all come from a generator.

    Where there are constraints, their violation is pymoo's only constraint, so that it ranks points
    as all methods do.

    Parameters
    ----------
    method
        Whose algorithm it is.
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
        kind, options = method.algorithm(size)
        # as a seed, a generator is used as it is
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
    """A choice of survivors with random numbers from a generator; pymoo's takes the system's.

    That would make the stochastic ranking of `isres` different each time.
    """

    def __init__(self, survival: Any, generator: np.random.Generator) -> None:
        self._survival, self._generator = survival, generator

    def do(self, *args: Any, **options: Any) -> Any:
        return self._survival.do(*args, **{**options, "random_state": self._generator})


@dataclass(frozen=True)
class PymooMethod(PopulationMethod):
    """A population that an algorithm of pymoo moves."""

    rivals: ClassVar[Rivals] = None
    """Whom a new point must be better than to survive: the one member in whose place it would come,
    or the worst of the population; None where it depends on other new points."""

    @abstractmethod
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        """Return the class of the algorithm, and what it is made with for generations of a size.

        Besides its first generation and seed.
        """

    @override
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        return PymooStrategy(self, box, size, goal, generator)


@dataclass(frozen=True)
class DifferentialEvolution(PymooMethod):
    """Each point steps by the difference of two others, and stays where that does not help.

    The population to try first where several minima are likely and all unknowns have bounds. It
    keeps inequality constraints, unless only a sliver between the bounds satisfies them. It needs
    thousands of simulations: with a single minimum `least_squares` needs a hundredth of them.

    R. Storn, K. Price, J. Global Optim. 11 (1997) 341-359, doi:10.1023/A:1008202821328.

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
    """The fittest of parents and children live on; children mix two parents and mutate.

    For costs that jump, or where good values of single unknowns can be combined. It finds the
    region of a minimum but few digits of it: go on from there with another method. Where `de`
    works, it needs fewer simulations.

    Simulated binary crossover of K. Deb, R. B. Agrawal, Complex Systems 9 (1995) 115-148, and
    polynomial mutation; constraints by the rules of K. Deb, Comput. Methods Appl. Mech. Engrg. 186
    (2000) 311-338, doi:10.1016/S0045-7825(99)00389-8.

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
    """An evolution strategy that now and then prefers a low cost to satisfied constraints.

    For minima on nonlinear constraints, above all where the region that satisfies them is narrow
    or in pieces; the only population here that keeps equalities. Without constraints `de` and
    `cmaes` need fewer simulations.

    T. P. Runarsson, X. Yao, IEEE Trans. SMC C 35 (2005) 233-243, doi:10.1109/TSMCC.2004.841906,
    with the ranking of T. P. Runarsson, X. Yao, IEEE Trans. Evol. Comput. 4 (2000) 284-294,
    doi:10.1109/4235.873238.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        Of every `PopulationMethod`. The usual population is 20 (unknowns + 1) points; every seventh
        becomes a parent. The best may be lost for a while, so the window is wide.
    ranking
        Probability that two points are ranked by cost although one violates a constraint. Above
        0.5 the constraints would lose. At 0 they always come first.
    gamma
        Length of the steps along the differences of the best points.
    alpha
        Rate of change of the step lengths: 0.2 smooths out chance.
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
    """Points fly on, drawn to the best point of their own and of all.

    For a look over a wide region with a small population. Its last digits come slowly: `de` and
    `cmaes` draw together faster.

    J. Kennedy, R. Eberhart, Proc. ICNN (1995) 1942-1948, doi:10.1109/ICNN.1995.488968, with the
    weights of M. Clerc, J. Kennedy, IEEE Trans. Evol. Comput. 6 (2002) 58-73,
    doi:10.1109/4235.985692, or the adaptation of Z. Zhan, J. Zhang, Y. Li, H. Chung, IEEE Trans.
    SMC B 39 (2009) 1362-1381, doi:10.1109/TSMCB.2009.2015956.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        Of every `PopulationMethod`. The usual population is 5 points per unknown, at least 25. It
        is made up of each particle's best point, which rarely come as close together as `xtol`.
    inertia, own, social
        Part of its velocity that a particle keeps, and how strongly its own best point and that of
        the swarm draw it. Below 0.73, 1.5, 1.5 the swarm settles sooner, above it may never.
    adaptive
        Change those three with the state of the swarm, beginning with 0.9, 2, 2. It comes to the
        last digits in fewer generations and is more often caught in a local minimum.
    speed
        Limit of the velocity: the part of the range between the bounds that one generation may
        cross.
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
