"""e(t) = (measured(t) - simulated(t)) / sigma at the measured times only, the default time base."""

from __future__ import annotations

from workers.grid import Grid
from workers.messages import FloatArray
from workers.residuals.base import ResidualKind


class MeasuredTimes(ResidualKind):
    """One residual for each measured value, in units of its standard deviation.

    The simulated value stands exactly at the measured time: the grid has it, nothing is
    interpolated.
    """

    def residuals(self, grid: Grid, outputs: FloatArray) -> FloatArray:
        simulated = outputs.reshape(len(outputs), -1)[:, grid.gather]
        return (grid.measured - simulated) / grid.sigmas
