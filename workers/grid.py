"""The time grid of a simulation, which contains all inputs and all measurements of an experiment.

A solver steps from one time of the grid to the next. So it never steps across a kink of an input,
and it reaches every time of a measurement exactly. A few measurements may lie between two samples
of the inputs. Then a step extends from one sample to the next and passes over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from workers.messages import Experiment, FloatArray, Input, IntArray

MOST_PASSED = 2
"""Largest number of consecutive times that a step may pass over. With more of them, measurements
and not inputs would limit the step."""
LEAST_PART = 1e-3
"""Smallest distance of the first passed time from the sample before it, as a fraction of the
distance between the samples. The slope of an input is computed from this distance."""


class SignalGrid(NamedTuple):
    """Signals of an experiment at the times of its grid.

    Attributes
    ----------
    times : (n,)
        Strictly increasing, from start to stop.
    intervals : (n,)
        Seconds from each time to the next.
    inputs : (n, m)
        Each input, then each signal, at each time; at a jump of a held signal, the value after it.
    slopes : (n, m)
        Slope of each signal in the interval that starts at this time; 0 for a held signal.
    jumps : (n,)
        Whether a held input jumps at this time.
    passed : (n,)
        Whether a step may pass over this time, because no input or signal has a sample there.
    gather : (k,)
        Index of the simulated value of each measurement in the flattened (n, recorded) outputs.
    measured : (k,)
        Measured values, output after output.
    sigmas : (k,)
        Standard deviation of each measured value.
    by_time : (k,)
        Positions of the measured values in the order of their times.
    row_ends : (n,)
        Number of measured values at this time or before.
    """

    times: FloatArray
    intervals: FloatArray
    inputs: FloatArray
    slopes: FloatArray
    jumps: IntArray
    passed: npt.NDArray[np.bool_]
    gather: IntArray
    measured: FloatArray
    sigmas: FloatArray
    by_time: IntArray
    row_ends: IntArray


def build_grid(experiment: Experiment, recorded: tuple[str, ...] = ()) -> SignalGrid:
    """Return the grid of an experiment's inputs, signals, measured times and constraints' times.

    `recorded` are the recorded variables; if empty, those of the experiment.
    """
    recorded = recorded or experiment.recorded
    start, stop = experiment.start, experiment.stop
    signals = (*experiment.inputs, *experiment.signals)
    sampled = [signal.times for signal in signals]
    times_of_signals = [*sampled, *(output.times for output in experiment.outputs)]
    times_of_signals += [
        output.reference.times
        for output in experiment.outputs
        if output.learns and output.reference is not None
    ]
    times_of_signals += [bound.times for bound in experiment.bounds]
    times_of_signals += [experiment.curve.times] if experiment.curve is not None else []
    times = np.unique(np.concatenate([*times_of_signals, [start, stop]]))
    times = times[(times >= start) & (times <= stop)]
    width = len(recorded)
    gather = [
        np.searchsorted(times, output.times) * width + recorded.index(output.variable)
        for output in experiment.outputs
    ]
    gathered = np.concatenate([np.zeros(0, np.intp), *gather])
    by_time = np.argsort(gathered, kind="stable")
    ends = np.arange(1, len(times) + 1) * width
    return on_times(experiment, times)._replace(
        passed=_passed(times, sampled),
        gather=gathered,
        by_time=by_time,
        row_ends=np.searchsorted(gathered[by_time], ends),
        measured=np.concatenate([np.zeros(0), *(output.values for output in experiment.outputs)]),
        sigmas=np.concatenate([np.zeros(0), *(output.sigmas for output in experiment.outputs)]),
    )


def _passed(times: FloatArray, sampled: Sequence[FloatArray]) -> npt.NDArray[np.bool_]:
    """Return whether a step may pass over each time, between two samples of inputs."""
    known = np.zeros(len(times), np.bool_)
    known[[0, -1]] = True
    for own in sampled:
        known[np.searchsorted(times, own[(own >= times[0]) & (own <= times[-1])])] = True
    stops = np.flatnonzero(known)
    between, lengths = np.diff(stops) - 1, np.diff(times[stops])
    parts = times[np.minimum(stops[:-1] + 1, len(times) - 1)] - times[stops[:-1]]
    few = (between <= MOST_PASSED) & (parts >= LEAST_PART * lengths) if sampled else between < 0
    return np.asarray(~known & np.append(np.repeat(few, between + 1), False))


def on_times(experiment: Experiment, times: FloatArray) -> SignalGrid:
    """Return an experiment's inputs and signals at given times, without measurements."""
    signals = (*experiment.inputs, *experiment.signals)
    inputs = [_sample(signal, times) for signal in signals]
    jumps = np.zeros(len(times), np.bool_)
    for signal, (values, _) in zip(experiment.inputs, inputs, strict=False):
        if signal.interpolation == "hold":
            jumps[1:] |= values[1:] != values[:-1]
    return SignalGrid(
        times=times,
        intervals=np.diff(times, append=times[-1:]),
        inputs=_columns([value for value, _ in inputs], len(times)),
        slopes=_columns([slope for _, slope in inputs], len(times)),
        jumps=jumps,
        passed=np.zeros(len(times), np.bool_),
        gather=np.zeros(0, np.intp),
        measured=np.zeros(0),
        sigmas=np.zeros(0),
        by_time=np.zeros(0, np.intp),
        row_ends=np.zeros(len(times), np.intp),
    )


def values_at(signal: Input, times: FloatArray) -> FloatArray:
    """Return a signal at given times, with its declared interpolation between samples."""
    if signal.interpolation == "linear":
        return np.asarray(np.interp(times, signal.times, signal.values))
    latest = np.searchsorted(signal.times, times, side="right") - 1
    return np.asarray(signal.values[np.maximum(latest, 0)])


def _sample(signal: Input, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a signal at each time of the grid, and its slope in the following interval."""
    values = values_at(signal, times)
    if signal.interpolation != "linear":
        return values, np.zeros_like(values)
    with np.errstate(over="ignore", invalid="ignore"):  # simulations with absurd slopes fail
        return values, np.append(np.diff(values) / np.diff(times), 0.0)


def _columns(columns: list[FloatArray], rows: int) -> FloatArray:
    return np.ascontiguousarray(np.column_stack(columns)) if columns else np.zeros((rows, 0))
