"""Base class of designs, which choose the simulated points and compute indices from their values.

A design samples the unit cube in groups of points. If a simulation fails, only its group is lost.
Indices are computed for one quantity at a time.
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
"""Relative range of a quantity up to which it is constant."""
RESAMPLES = 100
"""Number of resamples of the groups for intervals."""


@dataclass(frozen=True)
class SensitivityIndex:
    """A measure of the influence of each unknown on a quantity.

    Attributes
    ----------
    name
        Name of the measure, such as "total".
    values : (unknowns,)
        Value for each unknown; NaN if the quantity is constant.
    half_widths : (unknowns,)
        Half-widths of the 95 % intervals; NaN if they are not known.
    """

    name: str
    values: FloatArray
    half_widths: FloatArray


class SensitivityDesign(ABC):
    """A sampling of the unit cube, with its indices."""

    name: ClassVar[str]
    """Name of the design in a config."""

    measures: ClassVar[tuple[str, ...]]
    """Names of the indices in order."""

    ranks: ClassVar[str]
    """The index for the ranking of unknowns."""

    fewest: ClassVar[int]
    """Least number of groups for meaningful indices."""

    usual: ClassVar[int]
    """Default number of groups."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def group(self, size: int) -> int:
        """Return the number of points of a group for `size` unknowns."""

    @abstractmethod
    def sample(self, size: int, groups: int, generator: np.random.Generator) -> FloatArray:
        """Return points of the unit cube, one group after the other: (groups * group, size).

        Parameters
        ----------
        size
            Number of unknowns.
        groups
            Number of groups; it may be increased to the next possible number.
        generator
            Generates the random numbers.
        """

    def indices(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        """Return the indices of a quantity; NaN if it is constant.

        Parameters
        ----------
        points : (n, size)
            Complete groups of points from `sample`.
        values : (n,)
            Finite values of the quantity.
        generator
            Generates the resamples for the intervals.
        """
        if float(np.ptp(values)) <= ROUNDING_OF_QUANTITY * float(np.abs(values).max(initial=0.0)):
            nothing = np.full(points.shape[1], np.nan)
            return tuple(SensitivityIndex(name, nothing, nothing) for name in self.measures)
        return self.indices_of_moving(points, values, generator)

    @abstractmethod
    def indices_of_moving(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        """Return the indices of a quantity that is not constant."""


def half_widths(
    statistic: Callable[[IntArray], FloatArray], groups: int, generator: np.random.Generator
) -> FloatArray:
    """Return the half-widths of the 95 % intervals of a statistic, from a bootstrap of the groups.

    Parameters
    ----------
    statistic
        A function of the numbers of the groups, which may be repeated.
    groups
        Number of groups.
    generator
        Generates the resamples.
    """
    from scipy.stats import bootstrap  # slow to import

    numbers = [np.arange(groups)]
    found = bootstrap(numbers, statistic, n_resamples=RESAMPLES, method="percentile", rng=generator)
    return np.asarray(ndtri(0.975) * found.standard_error)
