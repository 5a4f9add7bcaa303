"""A cache of evaluations and derivatives, so that a library that calls back never asks twice."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from cluster_est.methods.base import Evaluation, Points, Progress
from cluster_est.methods.callback_bridge import Ask, run_with
from cluster_est.methods.derivatives.differences import SHORTER, Scheme, suitable_step
from cluster_est.methods.derivatives.gradients import CostDerivatives, derivatives
from cluster_est.methods.evaluation_status import is_defined
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray

CAPACITY = 32
"""Points; libraries ask again for the last few only."""


class EvaluationCache:
    """Evaluations and derivatives by point, and the best point.

    The library sees z = (x - origin) / typical, in which all unknowns are alike. The origin is the
    start, and may be moved to a point from which the library is to start anew.

    Parameters
    ----------
    space, ask
        The space that is searched, and the function that has points evaluated.
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
        self.failures = 0
        """Of points, one after the other."""
        self.progress = Progress(0, np.nan)
        self.best: tuple[FloatArray, Evaluation] | None = None

    def forget_derivatives(self) -> None:
        """Have all derivatives asked for anew, with other steps than those that failed."""
        relative = self._relative_step or suitable_step(self._space, self.scheme)
        self._relative_step = SHORTER * relative
        self._derivatives.clear()

    def point(self, z: FloatArray) -> FloatArray:
        """Return the point of the space: within bounds, and exactly the origin where z is 0."""
        space = self._space
        return np.clip(self.origin + np.asarray(z) * space.typical, space.lower, space.upper)

    def evaluation(self, z: FloatArray) -> Evaluation:
        """Return the evaluation at z; ask for it only if it is not in the cache."""
        x = self.point(z)
        key = x.tobytes()
        if key not in self._evaluations:
            purpose = "start" if self.best is None else "trial"
            (at,) = self._ask(Points(x[None, :], purpose, self.progress))
            self._evaluations[key] = at
            self.failures = 0 if is_defined(at) else self.failures + 1
            if len(self._evaluations) > CAPACITY:
                self._evaluations.popitem(last=False)
            if self.best is None or at.rank < self.best[1].rank:
                self.best = (x, at)
        return self._evaluations[key]

    def derivatives(self, z: FloatArray) -> CostDerivatives:
        """Return the derivatives at z by x; ask for them only if they are not in the cache."""
        return self._derivatives_at(self.point(z), self.evaluation(z))

    def derivatives_at_best(self) -> CostDerivatives:
        """Return those at the best point, which must be there."""
        assert self.best is not None
        return self._derivatives_at(*self.best)

    def _derivatives_at(self, x: FloatArray, at: Evaluation) -> CostDerivatives:
        key = (x.tobytes(), self.scheme)
        if key not in self._derivatives:
            self.gradients += 1
            requests = derivatives(
                self._space, x, at, self.scheme, self._relative_step, self.progress
            )
            self._derivatives[key] = run_with(requests, self._ask)
            if len(self._derivatives) > CAPACITY:
                self._derivatives.popitem(last=False)
        return self._derivatives[key]

    def has_derivatives(self, z: FloatArray) -> bool:
        """Return whether the derivatives at z are in the cache."""
        return (self.point(z).tobytes(), self.scheme) in self._derivatives
