"""Smooth curves through a few points."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from scipy.interpolate import PchipInterpolator
from typing_extensions import override

from cluster_est.experiment_design.waveforms.base import Waveform, WaveformGrid
from workers.messages import FloatArray

KNOTS = 12


class Spline(Waveform):
    """A smooth curve through twelve points, which nowhere leaves their range.

    F. N. Fritsch, R. E. Carlson, SIAM J. Numer. Anal. 17 (1980) 238-246, doi:10.1137/0717021.
    """

    name: ClassVar[str] = "spline"
    size: ClassVar[int] = KNOTS

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        count = max(3, min(KNOTS, 1 + int(grid.duration / grid.hold)))
        knots = np.linspace(0.0, grid.duration, count)
        return np.asarray(PchipInterpolator(knots, point[:count])(grid.times))
