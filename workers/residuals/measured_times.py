"""e(t) = (measured(t) - simulated(t)) / sigma at the measured times only, the default time base."""

from __future__ import annotations

import numpy as np

from workers.grid import SignalGrid
from workers.messages import FloatArray
from workers.residuals.base import Comparison, ComparisonResult, SimulatedBatch


class MeasuredTimes(Comparison):
    """One residual for each measured value, in units of its standard deviation.

    The simulated value stands exactly at the measured time: the grid has it, nothing is
    interpolated.
    """

    def __init__(self, grid: SignalGrid) -> None:
        self._grid = grid

    def compare(self, simulated: SimulatedBatch) -> ComparisonResult:
        grid, record = self._grid, simulated.record
        # take keeps each point's row contiguous: sums over strided rows round differently
        taken = np.take(record.reshape(len(record), -1), grid.gather, axis=1)
        with np.errstate(over="ignore"):  # what overflows is said to be not finite
            return ComparisonResult((grid.measured - taken) / grid.sigmas)

    def slopes(self, slopes: FloatArray) -> FloatArray:
        """(parameters, residuals): the residuals' derivatives, from those of the record."""
        grid = self._grid
        return -np.take(slopes.reshape(len(slopes), -1), grid.gather, axis=1) / grid.sigmas
