"""The contract of a design: which points of a box are simulated, and what their values say.

A design samples the unit cube in groups of points: a failed simulation takes its group away and no
more. The indices that it computes are of one quantity, whatever that is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import ndtri

from cluster_est.plug_in import check_class_attributes
from workers.messages import FloatArray, IntArray

ROUNDING_OF_QUANTITY = 1e-12
"""Range of a quantity over its size up to which it is constant."""
RESAMPLES = 100
"""Resamples of the groups, for intervals."""


@dataclass(frozen=True)
class SensitivityIndex:
    """One measure of how much each unknown moves a quantity.

    Attributes
    ----------
    name
        Such as "total".
    values : (unknowns,)
        One for each unknown; NaN where the quantity does not move at all.
    half_widths : (unknowns,)
        Of their 95 % intervals; NaN where nothing is known of them.
    """

    name: str
    values: FloatArray
    half_widths: FloatArray


class SensitivityDesign(ABC):
    """A sampling of the unit cube, with the indices that belong to it."""

    name: ClassVar[str]
    """As in a config."""

    measures: ClassVar[tuple[str, ...]]
    """Names of its indices, in their order."""

    ranks: ClassVar[str]
    """The index by which unknowns are ranked."""

    fewest: ClassVar[int]
    """Groups without which the indices mean nothing."""

    usual: ClassVar[int]
    """Groups where nobody asks for another number."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def group(self, size: int) -> int:
        """Return the points of a group for `size` unknowns."""

    @abstractmethod
    def sample(self, size: int, groups: int, generator: np.random.Generator) -> FloatArray:
        """Return points of the unit cube, group after group: (groups * group, size).

        Parameters
        ----------
        size
            Number of unknowns.
        groups
            As many, or the next number that the design can have.
        generator
            Of all that is random.
        """

    def indices(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        """Return the indices of a quantity; NaN where it does not move.

        Parameters
        ----------
        points : (n, size)
            Whole groups of what `sample` gave.
        values : (n,)
            Of the quantity, all finite.
        generator
            Of the resampling that their intervals come from.
        """
        if float(np.ptp(values)) <= ROUNDING_OF_QUANTITY * float(np.abs(values).max(initial=0.0)):
            nothing = np.full(points.shape[1], np.nan)
            return tuple(SensitivityIndex(name, nothing, nothing) for name in self.measures)
        return self.indices_of_moving(points, values, generator)

    @abstractmethod
    def indices_of_moving(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        """Return the same of a quantity that moves."""


def half_widths(
    statistic: Callable[[IntArray], FloatArray], groups: int, generator: np.random.Generator
) -> FloatArray:
    """Return half of the 95 % intervals of a statistic, from a bootstrap of the groups.

    Parameters
    ----------
    statistic
        Of the groups with these numbers, some of them more than once.
    groups
        How many there are.
    generator
        Of the resampling.
    """
    from scipy.stats import bootstrap  # slow to import

    numbers = [np.arange(groups)]
    found = bootstrap(numbers, statistic, n_resamples=RESAMPLES, method="percentile", rng=generator)
    return np.asarray(ndtri(0.975) * found.standard_error)
