"""Base class of comparisons of a simulation with its experiment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class SimulatedOutputs:
    """Recorded outputs of a batch of simulations of one experiment.

    Attributes
    ----------
    times : (n,)
        Times of the experiment's grid.
    names
        Names of the recorded variables.
    outputs : (points, n, names)
        Recorded values; not finite after a simulation has stopped early.
    values : (points, parameters)
        Values of the tasks.
    """

    times: FloatArray
    names: tuple[str, ...]
    outputs: FloatArray
    values: FloatArray

    def of(self, variable: str) -> FloatArray:
        """Return one recorded variable, (points, n)."""
        return self.outputs[:, :, self.names.index(variable)]


@dataclass
class ComparisonResult:
    """Values of a comparison, (points, k), and messages for points without them."""

    values: FloatArray
    failures: dict[int, str] = field(default_factory=dict)


class Comparison(ABC):
    """Computes residuals or constraints of simulations; one instance for each experiment.

    The number of values must be the same at every point, because methods subtract them.
    """

    @abstractmethod
    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        """Compare a batch of simulations with measurements, or with the limits of constraints."""


def positions(times: FloatArray, grid: FloatArray) -> IntArray:
    """Return the indices of times on a grid that contains all of them."""
    found: IntArray = np.searchsorted(grid, times)
    return found
