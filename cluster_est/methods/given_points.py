"""A method that decides nothing: it evaluates points that are given."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Method, Points, Search, Solution
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray


@dataclass(frozen=True)
class GivenPoints(Method):
    """Evaluate points, and end at the best of them.

    Attributes
    ----------
    points : (points, unknowns)
        In search coordinates.
    purpose
        For the log.
    seen
        Filled with the evaluations, in the order of the points.
    """

    name: ClassVar[str] = "look"
    needs_residuals: ClassVar[bool] = False

    keeps_constraints: ClassVar[bool] = True

    points: FloatArray
    purpose: str
    seen: list[Evaluation] = field(default_factory=list)

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        self.seen.extend((yield Points(self.points, self.purpose)))
        ok = [i for i, evaluation in enumerate(self.seen) if evaluation.ok]
        if not ok:
            return Solution(
                self.points[0], np.nan, Ending.START_FAILED, self.seen[0].reason, at=self.seen[0]
            )
        best = min(ok, key=lambda i: self.seen[i].rank)
        at = self.seen[best]
        return Solution(self.points[best], at.cost, Ending.CONVERGED, at=at)
