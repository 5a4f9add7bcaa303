"""The times of a simulation: all inputs and all measurements of an experiment on one grid.

A solver goes from one time of the grid to the next, so that it never steps across a kink of an
input, and stands exactly on every time at which something was measured. Where what was measured
lies between the samples of the inputs, which are about as dense, steps go from one of these to the
next, and pass over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from workers.messages import Experiment, FloatArray, Input, IntArray

MOST_PASSED = 2
"""Times in a row that a step may pass over: with more of them, they and not the inputs would be
what keeps steps short."""
LEAST_PART = 1e-3
"""Of the way to the next sample, that the first of them lies behind one: the slope of an input is
known from there."""


class SignalGrid(NamedTuple):
    """An experiment's signals at its times.

    Attributes
    ----------
    times : (n,)
        Strictly increasing, from start to stop.
    intervals : (n,)
        Seconds from each time to the next.
    inputs : (n, m)
        Each input, then each signal, at each time; where a held one jumps, its value after it.
    slopes : (n, m)
        The slope of each in the interval that starts at this time; 0 where it is held.
    jumps : (n,)
        Whether a held input jumps at this time.
    passed : (n,)
        Whether a step may pass over this time, as no input or signal has a sample there.
    gather : (k,)
        Index of each measured value's simulated one in the flattened (n, recorded) outputs.
    measured : (k,)
        Measured values, output after output.
    sigmas : (k,)
        Standard deviation of each.
    by_time : (k,)
        Positions of the measured values in the order of their times.
    row_ends : (n,)
        How many of them lie at this time or before.
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
    """Make one grid of an experiment's inputs, signals, measured times and constraints' times.

    `recorded` are the variables that are recorded; the experiment's own if empty.
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
    """Return the times that a step may pass over, between two at which inputs have samples."""
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
    """Make a grid of an experiment's inputs and signals at any times, with nothing measured."""
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
    """Return a signal at any times, between its samples as it is declared."""
    if signal.interpolation == "linear":
        return np.asarray(np.interp(times, signal.times, signal.values))
    latest = np.searchsorted(signal.times, times, side="right") - 1
    return np.asarray(signal.values[np.maximum(latest, 0)])


def _sample(signal: Input, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the input at each time of the grid, and its slope in the interval that follows."""
    values = values_at(signal, times)
    if signal.interpolation != "linear":
        return values, np.zeros_like(values)
    with np.errstate(over="ignore", invalid="ignore"):  # absurd slopes fail as simulations
        return values, np.append(np.diff(values) / np.diff(times), 0.0)


def _columns(columns: list[FloatArray], rows: int) -> FloatArray:
    return np.ascontiguousarray(np.column_stack(columns)) if columns else np.zeros((rows, 0))
