"""Steps: levels that are held."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.waveforms.base import Waveform, WaveformGrid
from workers.messages import FloatArray

MOST = 8


class Steps(Waveform):
    """Up to eight levels, each held for a time of its own."""

    name: ClassVar[str] = "steps"
    size: ClassVar[int] = 2 * MOST + 1

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        room = max(1, int(grid.duration / grid.hold))
        count = min(1 + int(point[0] * MOST), MOST, room)
        levels, spans = point[1 : 1 + MOST][:count], point[1 + MOST :][:count]
        ends = held_ends(spans, grid)
        places = np.searchsorted(ends[:-1], grid.times, side="right")
        return np.asarray(levels[places])


def held_ends(spans: FloatArray, grid: WaveformGrid) -> FloatArray:
    """Return when each of some levels ends: what is not held at least is shared out by `spans`."""
    free = max(grid.duration - len(spans) * grid.hold, 0.0)
    shares = spans + 1e-3
    return np.cumsum(grid.hold + free * shares / np.add.reduce(shares))
