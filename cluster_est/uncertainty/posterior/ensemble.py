"""An ensemble of walkers that draws from a posterior, as a search on the queue.

Half of the walkers move at a time, along differences of two others, so that each request is a batch
of simulations and no step size has to be chosen (C. J. F. ter Braak, Stat. Comput. 16 (2006)
239-249, doi:10.1007/s11222-006-8769-1), by the package emcee (D. Foreman-Mackey, D. W. Hogg, D.
Lang, J. Goodman, PASP 125 (2013) 306-312, doi:10.1086/670067).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.methods.base import Ending, Evaluation, Method, Points, Progress, Search, Solution
from cluster_est.methods.callback_bridge import Ask, search_in_thread
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.uncertainty.posterior.density import log_density
from workers.messages import FloatArray

WHOLE = 0.1
"""Share of the moves by a whole difference, which lead from one mode to another (ter Braak)."""


@dataclass
class WalkerChain:
    """The states of an ensemble, step after step, in search coordinates."""

    states: list[FloatArray] = field(default_factory=list)
    densities: list[FloatArray] = field(default_factory=list)
    failures: int = 0
    asked: int = 0

    def add(self, states: FloatArray, densities: FloatArray) -> None:
        self.states.append(states.copy())
        self.densities.append(densities.copy())


@dataclass(frozen=True, eq=False)
class EnsembleSampling(Method):
    """Move walkers, and keep where they were.

    Attributes
    ----------
    starts : (walkers, unknowns)
        In search coordinates, within the bounds.
    steps
        Of each walker.
    chain
        Takes what is drawn; a search that is cut short leaves in it what there was.
    """

    name: ClassVar[str] = "posterior"
    needs_residuals: ClassVar[bool] = False
    needs_every_residual: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    starts: FloatArray
    steps: int
    chain: WalkerChain

    @override
    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        return search_in_thread(lambda ask: self._draw(space, ask, generator))

    def _draw(self, space: SearchSpace, ask: Ask, generator: np.random.Generator) -> Solution:
        import emcee  # only a posterior needs it

        density = _Density(space, ask, self.chain)
        moves = [(emcee.moves.DEMove(), 1.0 - WHOLE), (emcee.moves.DEMove(gamma0=1.0), WHOLE)]
        sampler = emcee.EnsembleSampler(
            len(self.starts), space.size, density, vectorize=True, moves=moves
        )
        seed = int(generator.integers(2**32))
        sampler.random_state = np.random.RandomState(seed).get_state()
        steps = sampler.sample(
            self.starts, iterations=self.steps, store=False, skip_initial_state_check=True
        )
        try:
            with np.errstate(invalid="ignore"):  # from one point without a density to another
                for state in steps:
                    self.chain.add(state.coords, state.log_prob)
                    density.progress = Progress(len(self.chain.states), density.best_cost)
        except _NoDensityError:
            return Solution(space.start, np.nan, Ending.START_FAILED, "no walker has a density")
        best = density.best
        assert best is not None
        return Solution(best[0], best[1].cost, Ending.CONVERGED, iterations=self.steps, at=best[1])


class _NoDensityError(Exception):
    """No walker begins at a point with a density: moves would lead nowhere."""


class _Density:
    """The log density of many points at once, for the sampler to call."""

    def __init__(self, space: SearchSpace, ask: Ask, chain: WalkerChain) -> None:
        self._space, self._ask, self._chain = space, ask, chain
        self.progress = Progress(0, np.nan)
        self.best: tuple[FloatArray, Evaluation] | None = None
        self._begun = False

    @property
    def best_cost(self) -> float:
        return np.nan if self.best is None else self.best[1].cost

    def __call__(self, points: FloatArray) -> FloatArray:
        space = self._space
        found = np.full(len(points), -np.inf)
        inside = ((points >= space.lower) & (points <= space.upper)).all(axis=1)
        if not inside.any() and self._begun:
            return found
        asked = points[inside]
        answers = self._ask(Points(asked.copy(), "posterior", self.progress))
        self._chain.asked += len(answers)
        self._chain.failures += sum(not at.ok for at in answers)
        found[inside] = [log_density(space, x, at) for x, at in zip(asked, answers, strict=True)]
        for x, at in zip(asked, answers, strict=True):
            if at.ok and (self.best is None or at.rank < self.best[1].rank):
                self.best = x.copy(), at
        if not self._begun and not np.isfinite(found).any():
            raise _NoDensityError
        self._begun = True
        return found
