"""Particle swarm optimisation, by pymoo.

J. Kennedy, R. Eberhart, Proc. ICNN (1995) 1942-1948, doi:10.1109/ICNN.1995.488968, with the
weights of M. Clerc, J. Kennedy, IEEE Trans. Evol. Comput. 6 (2002) 58-73, doi:10.1109/4235.985692,
or the adaptation of Z. Zhan, J. Zhang, Y. Li, H. Chung, IEEE Trans. SMC B 39 (2009) 1362-1381,
doi:10.1109/TSMCB.2009.2015956.
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
class ParticleSwarm(PopulationMethod):
    """Points fly on, drawn to the best point of their own and of all.

    For a look over a wide region with a small population. Its last digits come slowly: `de` and
    `cmaes` draw together faster.

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
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        from pymoo.algorithms.soo.nonconvex.pso import PSO

        inertia, own, social = self.inertia, self.own, self.social
        if self.adaptive:
            inertia, own, social = 0.9, 2.0, 2.0
        return PymooStrategy(
            PSO,
            box,
            size,
            goal,
            generator,
            rivals="member",
            pop_size=size,
            w=inertia,
            c1=own,
            c2=social,
            adaptive=self.adaptive,
            max_velocity_rate=self.speed,
        )
