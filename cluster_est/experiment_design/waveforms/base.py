"""The contract of a waveform: a family of input signals, each of them a point of a cube.

A search sees points of the unit cube; a waveform makes a signal between 0 and 1 of one. The range
that the signal has between its input's limits, and the limit of its rate, are seen to here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cluster_est.experiment_design.limits import InputLimits
from cluster_est.plug_in import check_class_attributes
from workers.messages import FloatArray

LEVELS = 2
"""Coordinates of a point that every waveform has: the amplitude, and where it lies."""
LEAST_AMPLITUDE = 0.02
HELD_SAMPLES = 4
"""For which a level is held at least where nothing is said: else the samples do not show it."""


@dataclass(frozen=True)
class WaveformGrid:
    """Times at which an input is sampled.

    Attributes
    ----------
    times : (n,)
        In seconds from the beginning, evenly spaced.
    hold
        Seconds for which a level is held at least.
    """

    times: FloatArray
    hold: float

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    @property
    def step(self) -> float:
        return float(self.times[1] - self.times[0])


class Waveform(ABC):
    """A family of input signals."""

    name: ClassVar[str]
    """As in a file of limits."""

    size: ClassVar[int]
    """Coordinates of a point, besides those that every waveform has."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        """Return a signal between 0 and 1, (n,).

        Parameters
        ----------
        point : (size,)
            Of the unit cube.
        grid
            Where it is sampled, and how fast it may change.
        """

    def signal(self, point: FloatArray, times: FloatArray, limits: InputLimits) -> FloatArray:
        """Return a signal within its limits, in the input's unit.

        Parameters
        ----------
        point : (LEVELS + size,)
            Of the unit cube.
        times : (n,)
            In seconds from the beginning, evenly spaced.
        limits
            Of the input.
        """
        hold = max(limits.hold, HELD_SAMPLES * float(times[1] - times[0]))
        shape = np.clip(self.shape(point[LEVELS:], WaveformGrid(times, hold)), 0.0, 1.0)
        amplitude = LEAST_AMPLITUDE + (1.0 - LEAST_AMPLITUDE) * float(point[0])
        lowest = float(point[1]) * (1.0 - amplitude)
        values = limits.lower + (limits.upper - limits.lower) * (lowest + amplitude * shape)
        return within_rate(values, times, limits)


def within_rate(values: FloatArray, times: FloatArray, limits: InputLimits) -> FloatArray:
    """Return a signal that begins at its start and changes no faster than it may."""
    begin = float(values[0]) if limits.start is None else limits.start
    if np.isinf(limits.rate):
        return np.concatenate([[begin], values[1:]])
    most = limits.rate * float(times[1] - times[0])
    found = np.empty(len(values))
    found[0] = begin
    for i, value in enumerate(values[1:].tolist(), 1):
        found[i] = min(max(value, found[i - 1] - most), found[i - 1] + most)
    return found
