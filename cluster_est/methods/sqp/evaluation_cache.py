"""What a search has asked for already, so that a library that calls back never asks twice."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from cluster_est.methods.base import Evaluation, Points, Progress
from cluster_est.methods.callback_bridge import Ask, drive
from cluster_est.methods.derivatives.differences import Scheme
from cluster_est.methods.derivatives.gradients import CostDerivatives, derivatives
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

REMEMBERED = 32
"""Points; libraries ask again for the last few only."""


class EvaluationCache:
    """Evaluations and derivatives by point, and the best point.

    The library sees z = (x - origin) / typical, in which all unknowns are alike. The origin is the
    start, and may be moved to a point from which the library is to start anew.

    Parameters
    ----------
    space, ask
        Where to search, and how to have points evaluated.
    scheme, relative_step
        Of the differences; the scheme may be changed.
    """

    def __init__(self, space: SearchSpace, ask: Ask, scheme: Scheme, relative_step: float) -> None:
        self._space, self._ask, self._relative_step = space, ask, relative_step
        self._evaluations: OrderedDict[bytes, Evaluation] = OrderedDict()
        self._derivatives: OrderedDict[tuple[bytes, Scheme], CostDerivatives] = OrderedDict()
        self.origin = space.start
        self.scheme = scheme
        self.gradients = 0
        self.progress = Progress(0, np.nan)
        self.best: tuple[FloatArray, Evaluation] | None = None

    def point(self, z: FloatArray) -> FloatArray:
        """The point of the space: within the bounds, and exactly the origin where z is 0."""
        space = self._space
        return np.clip(self.origin + np.asarray(z) * space.typical, space.lower, space.upper)

    def evaluation(self, z: FloatArray) -> Evaluation:
        """The evaluation at z, asked for only if it is not known."""
        x = self.point(z)
        key = x.tobytes()
        if key not in self._evaluations:
            purpose = "start" if self.best is None else "trial"
            (at,) = self._ask(Points(x[None, :], purpose, self.progress))
            self._evaluations[key] = at
            if len(self._evaluations) > REMEMBERED:
                self._evaluations.popitem(last=False)
            if self.best is None or at.rank < self.best[1].rank:
                self.best = (x, at)
        return self._evaluations[key]

    def slopes(self, z: FloatArray) -> CostDerivatives:
        """The derivatives at z by x, asked for only if they are not known."""
        return self._slopes(self.point(z), self.evaluation(z))

    def slopes_at_best(self) -> CostDerivatives:
        """The same at the best point; only where there is one."""
        assert self.best is not None
        return self._slopes(*self.best)

    def _slopes(self, x: FloatArray, at: Evaluation) -> CostDerivatives:
        key = (x.tobytes(), self.scheme)
        if key not in self._derivatives:
            self.gradients += 1
            asking = derivatives(
                self._space, x, at, self.scheme, self._relative_step, self.progress
            )
            self._derivatives[key] = drive(asking, self._ask)
            if len(self._derivatives) > REMEMBERED:
                self._derivatives.popitem(last=False)
        return self._derivatives[key]

    def has_slopes(self, z: FloatArray) -> bool:
        """Whether `slopes` would ask for nothing."""
        return (self.point(z).tobytes(), self.scheme) in self._derivatives


def usable(at: Evaluation) -> bool:
    """Whether an evaluation has a cost and all its constraints."""
    return at.ok and not np.isnan(at.cost) and not bool(np.isnan(at.constraints).any())


def why_unusable(at: Evaluation) -> str:
    """The reason, for a message."""
    return at.reason or "the cost or a constraint has no value there"


def worst_constraint(space: SearchSpace, at: Evaluation) -> str:
    """Say which constraint is violated most, and by how much."""
    values = at.constraints
    if not len(values):
        return ""
    sizes = np.where(space.equality, np.abs(values), np.maximum(values, 0.0))
    worst = int(np.argmax(np.where(np.isnan(sizes), np.inf, sizes)))
    name = space.constraint_names[worst]
    return f"the constraint {name!r} is violated most, by {sizes[worst]:.3g} of its scale"
