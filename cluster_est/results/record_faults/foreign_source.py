"""A foreign source: a line in the residual of each record, of another frequency each time.

What a model lacks answers to what drives it, or rings at a frequency of its own. A line whose
frequency differs from record to record and is in no input comes from elsewhere: the mains, a pump,
another machine.
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
"""Samples of a record with a line."""
MOST_EVEN_STEPS = 2.0
"""Times its samples that a record may have even steps: of one with long gaps a spectrum is that of
straight lines."""
FEWEST_PERIODS = 3.0
"""Periods of a line in a record, or it is no line."""
SHARE = 0.8
"""Share of the squares beyond the noise that the line has in each record."""
SHARE_OF_INPUT = 0.3
"""Share of the squares of an input, in the same record, from which on the line is in it."""
STANDS_OUT = 30.0
"""Times the level of the spectrum around it that a line has. By chance one of n lines of noise of
any colour has it with a probability of n exp(-30)."""
AROUND, PEAK = 20, 3
"""Lines of the spectrum, to either side, that level is of, and those that are the peak's own."""
PADDING = 4
"""Times its length that a record is padded to: the peak lies between the lines of a spectrum."""


@dataclass(frozen=True)
class SpectralLine:
    """The strongest line of a record.

    Attributes
    ----------
    frequency
        In hertz.
    resolution
        One over the length of the record.
    rest : (n,)
        What is left without it.
    """

    frequency: float
    resolution: float
    rest: FloatArray


def foreign_source(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Find a line of another frequency in each record that is off, and in no input."""
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
    """Fit a sine of any frequency, beside a straight line."""
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
    """The mean of a spectrum around a line, by its median: both of exponential distributions."""
    numbers = np.arange(len(power))
    away = np.abs(numbers - place)
    near = power[(away > PADDING * PEAK) & (away <= PADDING * AROUND) & (numbers > 0)]
    return float(np.median(near)) / np.log(2.0) if len(near) else np.inf


def _without(signal: FloatArray, times: FloatArray, frequency: float) -> FloatArray:
    """A signal without a sine of this frequency and a straight line."""
    phase = 2.0 * np.pi * frequency * (times - times[0])
    ramp = np.linspace(-1.0, 1.0, len(times))
    matrix = np.column_stack([np.cos(phase), np.sin(phase), np.ones(len(times)), ramp])
    return OrthogonalProjection(matrix).remove(signal)


def _in_inputs(run: Experiment, frequency: float) -> bool:
    """Return whether much of an input is a sine of this frequency."""
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
    """Return whether the frequencies of records differ by more than they are blurred."""
    for number, one in enumerate(lines):
        for other in lines[:number]:
            if abs(one.frequency - other.frequency) > max(one.resolution, other.resolution):
                return True
    return False
