"""e(t) = (measured(t) - simulated(t)) / sigma at the measured times only, the default time base."""

from __future__ import annotations

import numpy as np

from workers.grid import Grid
from workers.messages import FloatArray
from workers.residuals.base import ResidualKind


class MeasuredTimes(ResidualKind):
    """One residual for each measured value, in units of its standard deviation.

    The simulated value stands exactly at the measured time: the grid has it, nothing is
    interpolated.
    """

    def residuals(self, grid: Grid, outputs: FloatArray) -> FloatArray:
        # take keeps each point's row contiguous: sums over strided rows round differently
        simulated = np.take(outputs.reshape(len(outputs), -1), grid.gather, axis=1)
        return (grid.measured - simulated) / grid.sigmas
