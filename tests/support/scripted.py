"""Searches that are written down step by step, for tests of what runs them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cluster_est.methods import Method
from cluster_est.methods.method import Ending, Points, Search, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.search_state import SearchRequest


@dataclass
class Scripted(Method):
    """Asks for what a generator function of the space yields."""

    steps: Callable[[SearchSpace], Search]
    name: ClassVar[str] = "scripted"
    needs_residuals: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        return self.steps(space)

    def on(self, space: SearchSpace, name: str = "search") -> SearchRequest:
        return SearchRequest(name, self, space)


def at(space: SearchSpace, values: Sequence[float]) -> np.ndarray:
    """Points like the start, but for these values of the first unknown."""
    x = np.tile(space.start, (len(values), 1))
    x[:, 0] = values
    return x


def ask(space: SearchSpace, values: Sequence[float], purpose: str = "ask", *more, **how) -> Points:
    return Points(at(space, values), purpose, *more, **how)


def ended(space: SearchSpace, cost: float = 0.0) -> Solution:
    """The start as the solution."""
    return Solution(space.start, cost, Ending.CONVERGED)
