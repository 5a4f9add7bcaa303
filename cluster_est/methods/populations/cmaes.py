"""Covariance matrix adaptation, with the package `cma`.

N. Hansen, A. Ostermeier, Evol. Comput. 9 (2001) 159-195, doi:10.1162/106365601750190398.

pymoo's wrapper of `cma` is not used: it seeds numpy's global generator, and treats every exception
as the end of the search.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

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

DEGENERATE = {"conditioncov", "noeffectaxis", "noeffectcoord", "tolupsigma"}
"""Termination criteria of `cma` for numerically degenerate distributions."""


@dataclass(frozen=True)
class Cmaes(PopulationMethod):
    """Evolution strategy that samples a normal distribution and adapts it to the better points.

    Among the population methods, try it first for one broad minimum with noise or jumps, where
    derivatives are useless. It adapts to dependencies between unknowns, and needs a small
    population. It begins at the start, so use several starts for several minima. Bounds are not
    necessary.

    It uses only the order of points: constraints first, then cost.

    Attributes
    ----------
    population, max_generations, xtol, ftol, window
        As in every `PopulationMethod`. The default population is 8 + 6 ln(unknowns) points, at
        least 16. This is at least twice the default of `cma`, which ends in local minima more
        often. Raise it for noisy simulations. The first generation also contains the start.
    sigma
        Standard deviation of the first generation, in units of the range between the bounds. If a
        bound is missing, it is in units of the size of the start. Lower it to stay near the start.
    """

    name: ClassVar[str] = "cmaes"
    needs_bounds: ClassVar[bool] = False
    least_population: ClassVar[int] = 4

    sigma: float = field(default=0.25, metadata={"least": 1e-6})

    @override
    def usual_population(self, unknowns: int) -> int:
        return max(16, int(8 + 6 * np.log(unknowns)))

    @override
    def strategy(
        self, box: UnitBox, size: int, goal: PopulationGoal, generator: np.random.Generator
    ) -> PopulationStrategy:
        return _EvolutionStrategy(box, self.sigma, size, generator)


class _EvolutionStrategy(PopulationStrategy):
    """The evolution strategy of `cma`, with random numbers from a generator and no output."""

    def __init__(
        self, box: UnitBox, sigma: float, size: int, generator: np.random.Generator
    ) -> None:
        options = {
            "popsize": size,
            "bounds": [_none_if_infinite(box.lower), _none_if_infinite(box.upper)],
            "seed": np.nan,
            "randn": lambda *shape: generator.standard_normal(shape),
            "verbose": -10,
            "maxiter": np.inf,
        }
        if box.space.size == 1:
            options["maxstd"] = np.inf  # the default limit raises an error with a single unknown
        with _quiet():
            cma = importlib.import_module("cma")
            self._strategy: Any = cma.CMAEvolutionStrategy(box.start, sigma, options)
        self._start: FloatArray | None = box.start
        self._sampled: list[FloatArray] = []
        self._numbers = range(0)

    def ask(self) -> FloatArray:
        first = [] if self._start is None else [self._start]
        with _quiet():
            if not first and DEGENERATE & set(self._strategy.stop()):
                return np.zeros((0, 0))
            self._sampled = self._strategy.ask()
        return np.array([*first, *self._sampled])

    def tell(self, numbers: range, members: Sequence[PopulationMember]) -> None:
        if self._start is not None:
            numbers, members = numbers[1:], members[1:]
            self._start = None
        self._numbers = numbers
        places = {rank: place for place, rank in enumerate(sorted({m.rank for m in members}))}
        with _quiet():
            self._strategy.tell(self._sampled, [float(places[m.rank]) for m in members])

    def bounds(self) -> FloatArray:
        return np.full(len(self._sampled) + (self._start is not None), np.inf)

    def survivors(self) -> list[int]:
        return list(self._numbers)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the warnings of `cma`, and undo its changes of the warning filters."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _none_if_infinite(bounds: FloatArray) -> list[float | None]:
    return [bound if np.isfinite(bound) else None for bound in bounds.tolist()]
