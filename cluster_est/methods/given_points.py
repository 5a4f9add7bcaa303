"""A method that decides nothing: it evaluates points that are given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cluster_est.methods.base import Ending, Method, Points, Search, Solution
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray
from workers.messages.equality import by_content


@by_content
@dataclass(frozen=True)
class GivenPoints(Method):
    """Evaluate points, and end at the best of them; the solution carries all evaluations.

    Attributes
    ----------
    points : (points, unknowns)
        In search coordinates.
    purpose
        For the log.
    """

    name: ClassVar[str] = "look"
    needs_residuals: ClassVar[bool] = False

    keeps_constraints: ClassVar[bool] = True

    points: FloatArray
    purpose: str

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        del space, generator  # the points are given
        found = tuple((yield Points(self.points, self.purpose)))
        ok = [i for i, evaluation in enumerate(found) if evaluation.ok]
        if not ok:
            first = found[0]
            return Solution(
                self.points[0],
                np.nan,
                Ending.START_FAILED,
                first.reason,
                at=first,
                evaluations=found,
            )
        best = min(ok, key=lambda i: found[i].rank)
        at = found[best]
        return Solution(self.points[best], at.cost, Ending.CONVERGED, at=at, evaluations=found)
