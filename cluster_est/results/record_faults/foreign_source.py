"""A foreign source: a spectral line in each record's residual, each with a different frequency.

An effect that the model lacks responds to the inputs, or oscillates at a fixed natural frequency. A
line comes from elsewhere (the mains, a pump, another machine) if its frequency differs between
records and occurs in no input.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import rfft, rfftfreq
from scipy.optimize import minimize_scalar

from cluster_est.results.record_faults.fault import RecordFault
from cluster_est.results.record_faults.fitted_records import OFF, FittedRecords
from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.records import OutputRecord
from workers.messages import Experiment, FloatArray

SHORTEST = 32
"""Least number of samples of a record for this test."""
MOST_EVEN_STEPS = 2.0
"""Largest number of even steps over the number of samples. A record with long gaps has more, and
its spectrum would be that of the straight lines in the gaps."""
FEWEST_PERIODS = 3.0
"""Least number of periods of a line in a record."""
SHARE = 0.8
"""Least share of the line in each record's sum of squares beyond the noise."""
SHARE_OF_INPUT = 0.3
"""Share of an input's sum of squares above which the line counts as part of this input."""
STANDS_OUT = 30.0
"""Least ratio of a line to the level of the spectrum around it. In noise of any colour, one of n
lines reaches it with a probability of n exp(-30)."""
AROUND, PEAK = 20, 3
"""Number of spectral lines on each side that give this level, and that belong to the peak."""
PADDING = 4
"""Zero padding, as a multiple of the record's length, to find a peak between spectral lines."""


@dataclass(frozen=True)
class SpectralLine:
    """The strongest spectral line of a record.

    Attributes
    ----------
    frequency
        Frequency in hertz.
    resolution
        One over the length of the record.
    rest : (n,)
        The signal without the line.
    """

    frequency: float
    resolution: float
    rest: FloatArray


def foreign_source(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find lines with different frequencies in all poorly fitted records, but in no input."""
    noise = fitted.noise_here
    residuals = fitted.residuals
    before = fitted.levels(residuals, fitted.runs, noise)
    lines: dict[int, SpectralLine] = {}
    outputs: set[str] = set()
    rest = residuals.copy()
    for item in fitted.records.items:
        size = float(np.sqrt(np.mean(residuals[item.rows] ** 2))) if len(item.times) else 0.0
        if not size > OFF * noise[item.output]:
            continue
        line = _line(residuals[item.rows], item)
        if line is None:
            return ()
        own = float(noise[item.output]) ** 2
        excess = size**2 - own
        if not size**2 - float(np.mean(line.rest**2)) >= SHARE * excess:
            return ()
        if _in_inputs(fitted.runs[item.experiment], line.frequency):
            return ()
        known = lines.setdefault(item.experiment, line)
        if abs(known.frequency - line.frequency) > line.resolution:
            return ()  # two lines in one record
        outputs.add(fitted.records.outputs[item.output])
        rest[item.rows] = line.rest
    found = list(lines.values())
    if len(found) < 2 or not _differ(found):
        return ()
    frequencies = [line.frequency for line in found]
    after = fitted.levels(rest, fitted.runs, noise)
    named = tuple(name for name in fitted.records.outputs if name in outputs)
    span = (min(frequencies), max(frequencies))
    return (
        RecordFault(
            "foreign source", "", "outputs", named, float(np.mean(frequencies)),
            float(before.max()), float(after.max()), frequencies=span,
        ),
    )  # fmt: skip


def _line(signal: FloatArray, item: OutputRecord) -> SpectralLine | None:
    """Fit a sine of unknown frequency and a straight line."""
    times = item.times
    if len(times) < SHORTEST:
        return None
    step, length = float(np.median(np.diff(times))), float(times[-1] - times[0])
    count = int(length / step) + 1
    if count > MOST_EVEN_STEPS * len(times):
        return None
    even = np.interp(times[0] + step * np.arange(count), times, signal)
    even = even - np.polyval(np.polyfit(np.arange(count), even, 1), np.arange(count))
    power = np.abs(rfft(even, PADDING * count)) ** 2
    frequencies = rfftfreq(PADDING * count, step)
    allowed = frequencies >= FEWEST_PERIODS / length
    if not allowed.any():
        return None
    place = int(np.flatnonzero(allowed)[np.argmax(power[allowed])])
    if not power[place] > STANDS_OUT * _level_around(power, place):
        return None
    peak = float(frequencies[place])

    def left(frequency: float) -> float:
        return float(np.sum(_without(signal, times, frequency) ** 2))

    best = minimize_scalar(
        left, bounds=(peak - 0.5 / length, peak + 0.5 / length), method="bounded",
        options={"xatol": 1e-3 / length},
    ).x  # fmt: skip
    return SpectralLine(float(best), 1.0 / length, _without(signal, times, float(best)))


def _level_around(power: FloatArray, place: int) -> float:
    """Return the mean of a spectrum around a line, from its median (exponential distribution)."""
    numbers = np.arange(len(power))
    away = np.abs(numbers - place)
    near = power[(away > PADDING * PEAK) & (away <= PADDING * AROUND) & (numbers > 0)]
    return float(np.median(near)) / np.log(2.0) if len(near) else np.inf


def _without(signal: FloatArray, times: FloatArray, frequency: float) -> FloatArray:
    """Return a signal without a sine of this frequency and without a straight line."""
    phase = 2.0 * np.pi * frequency * (times - times[0])
    ramp = np.linspace(-1.0, 1.0, len(times))
    matrix = np.column_stack([np.cos(phase), np.sin(phase), np.ones(len(times)), ramp])
    return OrthogonalProjection(matrix).remove(signal)


def _in_inputs(run: Experiment, frequency: float) -> bool:
    """Return whether a considerable part of an input is a sine of this frequency."""
    for given in (*run.inputs, *run.signals):
        values = given.values - np.mean(given.values)
        total = float(np.sum(values**2))
        if len(values) < SHORTEST or not total > 0.0:
            continue
        rest = float(np.sum(_without(values, given.times, frequency) ** 2))
        trend = float(np.sum(_without(values, given.times, 0.0) ** 2))
        if trend - rest > SHARE_OF_INPUT * total:
            return True
    return False


def _differ(lines: list[SpectralLine]) -> bool:
    """Return whether the frequencies of records differ by more than their resolution."""
    for number, one in enumerate(lines):
        for other in lines[:number]:
            if abs(one.frequency - other.frequency) > max(one.resolution, other.resolution):
                return True
    return False
