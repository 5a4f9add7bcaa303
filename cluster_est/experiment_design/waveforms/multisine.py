"""Multisines: a few sinusoids at once."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.experiment_design.waveforms.base import Waveform, WaveformGrid
from workers.messages import FloatArray

LINES = 6


class Multisine(Waveform):
    """Six sinusoids, of frequencies from one period in the record up to what may be fed in.

    R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach (2012), chapter 5,
    doi:10.1002/9781118287422.
    """

    name: ClassVar[str] = "multisine"
    size: ClassVar[int] = 3 * LINES

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        where, strength, phase = point[:LINES], point[LINES : 2 * LINES], point[2 * LINES :]
        lowest = 1.0 / grid.duration
        highest = max(0.5 / grid.hold, lowest)
        places = (np.arange(LINES) + where) / LINES
        frequencies = lowest * (highest / lowest) ** places
        angles = 2.0 * np.pi * (np.outer(grid.times, frequencies) + phase)
        wave = np.sin(angles) @ (strength + 1e-3)
        return np.asarray(0.5 + 0.5 * wave / float(np.abs(wave).max()))
