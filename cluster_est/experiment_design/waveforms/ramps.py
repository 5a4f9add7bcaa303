"""Ramps: straight lines between corners."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.waveforms.base import Waveform, WaveformGrid
from cluster_est.experiment_design.waveforms.steps import held_ends
from workers.messages import FloatArray

MOST = 8


class Ramps(Waveform):
    """Up to eight straight lines."""

    name: ClassVar[str] = "ramps"
    size: ClassVar[int] = 2 * MOST + 2

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        room = max(1, int(grid.duration / grid.hold))
        count = min(1 + int(point[0] * MOST), MOST, room)
        corners = point[1 : 2 + MOST][: count + 1]
        ends = held_ends(point[2 + MOST :][:count], grid)
        return np.interp(grid.times, np.concatenate([[0.0], ends]), corners)
