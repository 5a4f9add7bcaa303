"""e(t) = (measured(t) - simulated(t)) / sigma at the measured times only, the default time base."""

from __future__ import annotations

import numpy as np

from workers.grid import SignalGrid
from workers.messages import FloatArray
from workers.residuals.base import Comparison, ComparisonResult, SimulatedOutputs


class MeasuredTimes(Comparison):
    """One residual for each measured value, in units of its standard deviation.

    The simulated value stands exactly at the measured time: the grid has it, nothing is
    interpolated.
    """

    def __init__(self, grid: SignalGrid) -> None:
        self._grid = grid

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        grid, outputs = self._grid, simulated.outputs
        # take keeps each point's row contiguous: sums over strided rows round differently
        simulated_values = np.take(outputs.reshape(len(outputs), -1), grid.gather, axis=1)
        with np.errstate(over="ignore"):  # what overflows is said to be not finite
            return ComparisonResult((grid.measured - simulated_values) / grid.sigmas)

    def jacobian(self, sensitivities: FloatArray) -> FloatArray:
        """Return the (parameters, residuals) derivatives, from those of the outputs."""
        grid = self._grid
        return (
            -np.take(sensitivities.reshape(len(sensitivities), -1), grid.gather, axis=1)
            / grid.sigmas
        )
