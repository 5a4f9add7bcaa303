"""Methods: what picks the next points. One file a method.

A new method is one file with a subclass of `Method` and one line here.
"""

from __future__ import annotations

from cluster_est.methods.asynchronous_pattern_search import AsynchronousPatternSearch
from cluster_est.methods.base import Method
from cluster_est.methods.cmaes import Cmaes
from cluster_est.methods.differential_evolution import DifferentialEvolution
from cluster_est.methods.genetic import Genetic
from cluster_est.methods.isres import Isres
from cluster_est.methods.least_squares import LeastSquares
from cluster_est.methods.nelder_mead import NelderMead
from cluster_est.methods.nsga2 import Nsga2
from cluster_est.methods.particle_swarm import ParticleSwarm
from cluster_est.methods.pattern_search import PatternSearch
from cluster_est.methods.scipy_least_squares import ScipyLeastSquares
from cluster_est.methods.sqp import Sqp

METHODS: dict[str, type[Method]] = {
    LeastSquares.name: LeastSquares,
    Sqp.name: Sqp,
    NelderMead.name: NelderMead,
    PatternSearch.name: PatternSearch,
    AsynchronousPatternSearch.name: AsynchronousPatternSearch,
    DifferentialEvolution.name: DifferentialEvolution,
    Cmaes.name: Cmaes,
    ParticleSwarm.name: ParticleSwarm,
    Genetic.name: Genetic,
    Isres.name: Isres,
    Nsga2.name: Nsga2,
    ScipyLeastSquares.name: ScipyLeastSquares,
}

ALIASES = {
    "lsqnonlin": LeastSquares.name,
    "fmincon": Sqp.name,
    "fminsearch": NelderMead.name,
    "fminbnd": NelderMead.name,
    "patternsearch": PatternSearch.name,
}
"""Names that users of other tools know."""

__all__ = ["ALIASES", "METHODS", "Method"]
