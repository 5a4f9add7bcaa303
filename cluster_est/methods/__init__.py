"""Search methods, which choose the points to evaluate.

A new method needs a file with a subclass of `Method`, and an entry in `SEARCH_METHODS`.
"""

from __future__ import annotations

from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.least_squares.scipy_least_squares import ScipyLeastSquares
from cluster_est.methods.method import Method
from cluster_est.methods.nelder_mead import NelderMead
from cluster_est.methods.pattern_search.asynchronous import AsynchronousPatternSearch
from cluster_est.methods.pattern_search.synchronous import PatternSearch
from cluster_est.methods.populations.cmaes import Cmaes
from cluster_est.methods.populations.nsga2 import Nsga2
from cluster_est.methods.populations.pymoo_methods import (
    DifferentialEvolution,
    GeneticAlgorithm,
    Isres,
    ParticleSwarm,
)
from cluster_est.methods.sqp.sqp import Sqp

SEARCH_METHODS: dict[str, type[Method]] = {
    LeastSquares.name: LeastSquares,
    Sqp.name: Sqp,
    NelderMead.name: NelderMead,
    PatternSearch.name: PatternSearch,
    AsynchronousPatternSearch.name: AsynchronousPatternSearch,
    DifferentialEvolution.name: DifferentialEvolution,
    Cmaes.name: Cmaes,
    ParticleSwarm.name: ParticleSwarm,
    GeneticAlgorithm.name: GeneticAlgorithm,
    Isres.name: Isres,
    Nsga2.name: Nsga2,
    ScipyLeastSquares.name: ScipyLeastSquares,
}

METHOD_ALIASES = {
    "lsqnonlin": LeastSquares.name,
    "fmincon": Sqp.name,
    "fminsearch": NelderMead.name,
    "fminbnd": NelderMead.name,
    "patternsearch": PatternSearch.name,
}
"""Names of similar functions in other tools."""

__all__ = [
    "METHOD_ALIASES",
    "SEARCH_METHODS",
    "AsynchronousPatternSearch",
    "Cmaes",
    "DifferentialEvolution",
    "GeneticAlgorithm",
    "Isres",
    "LeastSquares",
    "Method",
    "NelderMead",
    "Nsga2",
    "ParticleSwarm",
    "PatternSearch",
    "ScipyLeastSquares",
    "Sqp",
]
