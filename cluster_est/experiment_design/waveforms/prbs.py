"""Random binary sequences."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.waveforms.base import Waveform, WaveformGrid
from workers.messages import FloatArray

BITS = 63


class BinarySequence(Waveform):
    """Two levels, between which chance switches at the ticks of a clock.

    L. Ljung, System Identification: Theory for the User (1999), section 13.3.
    """

    name: ClassVar[str] = "prbs"
    size: ClassVar[int] = BITS + 1

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        slowest = max(grid.duration / 3.0, grid.hold)
        clock = grid.hold * (slowest / grid.hold) ** float(point[0])
        clock = max(clock, grid.duration / BITS)
        bits = (point[1:] > 0.5).astype(np.float64)
        places = np.minimum((grid.times / clock).astype(int), BITS - 1)
        return np.asarray(bits[places])
