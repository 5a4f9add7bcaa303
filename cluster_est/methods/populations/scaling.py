"""The unit box of a population: from search coordinates to numbers of order one and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import FloatArray


@dataclass(frozen=True)
class UnitBox:
    """The coordinates of a strategy.

    The bounds of an unknown become 0 and 1. Where it lacks one, 0 is its start and 1 is as far
    from that as its typical size.
    """

    space: SearchSpace

    @cached_property
    def bounded(self) -> npt.NDArray[np.bool_]:
        """(unknowns,): True where both bounds are finite."""
        return np.isfinite(self.space.lower) & np.isfinite(self.space.upper)

    @cached_property
    def _origin(self) -> FloatArray:
        return np.where(self.bounded, self.space.lower, self.space.start)

    @cached_property
    def _scale(self) -> FloatArray:
        upper = np.where(self.bounded, self.space.upper, self.space.start + self.space.typical)
        return np.asarray(upper - self._origin, np.float64)

    @cached_property
    def start(self) -> FloatArray:
        return self._units(self.space.start)

    @cached_property
    def lower(self) -> FloatArray:
        return self._units(self.space.lower)

    @cached_property
    def upper(self) -> FloatArray:
        return np.where(self.bounded, 1.0, self._units(self.space.upper))

    def _units(self, x: FloatArray) -> FloatArray:
        return np.asarray((x - self._origin) / self._scale, np.float64)

    def points(self, units: FloatArray) -> FloatArray:
        """Return points in search coordinates, within bounds; the start as it was given."""
        x = np.where(units == self.start, self.space.start, self._origin + units * self._scale)
        return np.clip(x, self.space.lower, self.space.upper)

    def first_generation(self, size: int, generator: np.random.Generator) -> FloatArray:
        """Return the start and a Latin hypercube between the bounds.

        M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239-245,
        doi:10.1080/00401706.1979.10489755.
        """
        count = size - 1
        cells = np.array([generator.permutation(count) for _ in range(self.space.size)]).T
        return np.vstack([self.start, (cells + generator.random(cells.shape)) / count])
