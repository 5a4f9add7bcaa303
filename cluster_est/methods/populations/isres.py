"""Evolution strategy with improved stochastic ranking, by pymoo.

T. P. Runarsson, X. Yao, IEEE Trans. SMC C 35 (2005) 233-243, doi:10.1109/TSMCC.2004.841906, with
the ranking of T. P. Runarsson, X. Yao, IEEE Trans. Evol. Comput. 4 (2000) 284-294,
doi:10.1109/4235.873238.
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
class Isres(PopulationMethod):
    """An evolution strategy that now and then prefers a low cost to satisfied constraints.

    For minima on nonlinear constraints, above all where the region that satisfies them is narrow
    or in pieces; the only population here that keeps equalities. Without constraints `de` and
    `cmaes` need fewer simulations.

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
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        from pymoo.algorithms.soo.nonconvex.isres import ISRES

        return PymooStrategy(
            ISRES,
            box,
            size,
            goal,
            generator,
            n_offsprings=size,
            PF=self.ranking,
            gamma=self.gamma,
            alpha=self.alpha,
        )
