"""The contract of what compares a simulation with its experiment."""

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
        Of the experiment's grid.
    names
        Of the recorded variables.
    outputs : (points, n, names)
        Recorded values; not finite where a simulation stopped early.
    values : (points, parameters)
        The values of the tasks.
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
    """Makes residuals or constraints of simulations; one for each experiment that needs it.

    How many there are must be the same for every point, because methods subtract them.
    """

    @abstractmethod
    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        """Compare a batch of simulations with measurements, or with the limits of constraints."""


def positions(times: FloatArray, grid: FloatArray) -> IntArray:
    """Return the indices of times on a grid that has each of them."""
    found: IntArray = np.searchsorted(grid, times)
    return found
