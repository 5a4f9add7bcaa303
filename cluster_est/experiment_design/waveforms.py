"""Waveforms: families of input signals, in which each signal is a point of a unit cube.

A search selects points of the cube, and a waveform converts a point to a signal between 0 and 1.
The base class scales the signal to a range within its input's limits, and limits its rate. To add a
waveform, derive a class from it here, and add its name to `WAVEFORMS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.interpolate import PchipInterpolator
from typing_extensions import override

from cluster_est.experiment_design.limits import InputLimits
from cluster_est.plug_in import check_class_attributes
from workers.messages import FloatArray

LEVEL_COORDINATES = 2
"""Number of coordinates that every waveform has: the amplitude and its position."""
LEAST_AMPLITUDE = 0.02
HELD_SAMPLES = 4
"""Default smallest number of samples of a level; shorter levels would not be visible in them."""


@dataclass(frozen=True)
class WaveformGrid:
    """Times at which an input is sampled.

    Attributes
    ----------
    times : (n,)
        In seconds from the beginning, evenly spaced.
    hold
        Shortest duration of a level in seconds.
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
    """Name in a limits file."""

    size: ClassVar[int]
    """Number of coordinates of a point, besides those that every waveform has."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        """Return a signal between 0 and 1, (n,).

        Parameters
        ----------
        point : (size,)
            Point of the unit cube.
        grid
            Its sampling times, and the shortest duration of a level.
        """

    def signal(self, point: FloatArray, times: FloatArray, limits: InputLimits) -> FloatArray:
        """Return a signal within its limits, in the input's unit.

        Parameters
        ----------
        point : (LEVELS + size,)
            Point of the unit cube.
        times : (n,)
            In seconds from the beginning, evenly spaced.
        limits
            Limits of the input.
        """
        hold = max(limits.hold, HELD_SAMPLES * float(times[1] - times[0]))
        shape = np.clip(self.shape(point[LEVEL_COORDINATES:], WaveformGrid(times, hold)), 0.0, 1.0)
        amplitude = LEAST_AMPLITUDE + (1.0 - LEAST_AMPLITUDE) * float(point[0])
        lowest = float(point[1]) * (1.0 - amplitude)
        values = limits.lower + (limits.upper - limits.lower) * (lowest + amplitude * shape)
        return within_rate(values, times, limits)


def within_rate(values: FloatArray, times: FloatArray, limits: InputLimits) -> FloatArray:
    """Return a signal with the given start value and a limited rate of change."""
    begin = float(values[0]) if limits.start is None else limits.start
    if np.isinf(limits.rate):
        return np.concatenate([[begin], values[1:]])
    most = limits.rate * float(times[1] - times[0])
    found = np.empty(len(values))
    found[0] = begin
    for i, value in enumerate(values[1:].tolist(), 1):
        found[i] = min(max(value, found[i - 1] - most), found[i - 1] + most)
    return found


MOST_LEVELS = 8
"""Largest number of levels or lines of one signal."""


class Steps(Waveform):
    """Up to eight levels, each with its own duration."""

    name: ClassVar[str] = "steps"
    size: ClassVar[int] = 2 * MOST_LEVELS + 1

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        room = max(1, int(grid.duration / grid.hold))
        count = min(1 + int(point[0] * MOST_LEVELS), MOST_LEVELS, room)
        levels, spans = point[1 : 1 + MOST_LEVELS][:count], point[1 + MOST_LEVELS :][:count]
        ends = held_ends(spans, grid)
        places = np.searchsorted(ends[:-1], grid.times, side="right")
        return np.asarray(levels[places])


def held_ends(spans: FloatArray, grid: WaveformGrid) -> FloatArray:
    """Return the ends of levels; time beyond their shortest durations is divided by `spans`."""
    free = max(grid.duration - len(spans) * grid.hold, 0.0)
    shares = spans + 1e-3
    return np.cumsum(grid.hold + free * shares / np.add.reduce(shares))


class Ramps(Waveform):
    """Up to eight straight lines."""

    name: ClassVar[str] = "ramps"
    size: ClassVar[int] = 2 * MOST_LEVELS + 2

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        room = max(1, int(grid.duration / grid.hold))
        count = min(1 + int(point[0] * MOST_LEVELS), MOST_LEVELS, room)
        corners = point[1 : 2 + MOST_LEVELS][: count + 1]
        ends = held_ends(point[2 + MOST_LEVELS :][:count], grid)
        return np.interp(grid.times, np.concatenate([[0.0], ends]), corners)


LINES = 6


class Multisine(Waveform):
    """Six sinusoids, with frequencies from one period in the record up to the largest allowed.

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


BITS = 63


class BinarySequence(Waveform):
    """Two levels, with random switches at the ticks of a clock.

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


KNOTS = 12


class Spline(Waveform):
    """A smooth curve through twelve points, which stays within their range.

    F. N. Fritsch, R. E. Carlson, SIAM J. Numer. Anal. 17 (1980) 238-246, doi:10.1137/0717021.
    """

    name: ClassVar[str] = "spline"
    size: ClassVar[int] = KNOTS

    @override
    def shape(self, point: FloatArray, grid: WaveformGrid) -> FloatArray:
        count = max(3, min(KNOTS, 1 + int(grid.duration / grid.hold)))
        knots = np.linspace(0.0, grid.duration, count)
        return np.asarray(PchipInterpolator(knots, point[:count])(grid.times))


WAVEFORMS: dict[str, Waveform] = {
    waveform.name: waveform
    for waveform in (Steps(), Ramps(), Multisine(), BinarySequence(), Spline())
}
