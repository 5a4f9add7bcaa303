"""The effects on whole signals: those of actuators before, and of sensors after the simulation.

A signal holds one column for each run, on a grid of constant step. Every form is a function of
its numbers ``a``, the times, the signal, and another signal ``v`` that it may depend on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import expm

from closed_loop_benchmark.system import Array

Numbers = Sequence[float]
Form = Callable[[Numbers, Array, Array, Array], Array]


def lag(time: Array, signal: Array, constant: float, start: Array | None = None) -> Array:
    """Return a signal behind a first-order lag, exact for straight lines between the samples."""
    step = time[1] - time[0]
    keep, out = np.exp(-step / constant), np.empty_like(signal)
    out[0] = signal[0] if start is None else start
    behind = constant * np.diff(signal, axis=0) / step
    for n, shift in enumerate(behind):
        out[n + 1] = signal[n + 1] - shift + (out[n] - signal[n] + shift) * keep
    return out


def delay(time: Array, signal: Array, seconds: float) -> Array:
    """Return a signal as it was some seconds ago; before the start it was as at the start."""
    columns = [np.interp(time - seconds, time, column) for column in signal.T]
    return np.column_stack(columns)


def backlash(signal: Array, half_width: float) -> Array:
    """Return a signal behind a play that it has to cross when it turns."""
    out = np.empty_like(signal)
    out[0] = signal[0]
    for n in range(1, len(signal)):
        out[n] = np.clip(out[n - 1], signal[n] - half_width, signal[n] + half_width)
    return out


def rate_limit(time: Array, signal: Array, fastest: float) -> Array:
    """Return a signal that follows no faster than a rate."""
    most, out = fastest * (time[1] - time[0]), np.empty_like(signal)
    out[0] = signal[0]
    for n in range(1, len(signal)):
        out[n] = np.clip(signal[n], out[n - 1] - most, out[n - 1] + most)
    return out


def hysteresis(time: Array, signal: Array, width: float) -> Array:
    """Return a memory between -1 and 1 that follows the signal's integral and saturates."""
    moved, out = signal * (time[1] - time[0]) / width, np.zeros_like(signal)
    for n in range(1, len(signal)):
        end = np.sign(moved[n])
        out[n] = end + (out[n - 1] - end) * np.exp(-np.abs(moved[n]))
    return out


def mode(time: Array, signal: Array, frequency: float, damping: float) -> Array:
    """Return a signal behind an oscillator with two states, at rest at the first value.

    Exact for straight lines between the samples: on those, the oscillator settles to a straight
    line, and what is left of its state rotates and decays.
    """
    rate, step = 2.0 * np.pi * frequency, time[1] - time[0]
    system = np.array([[0.0, 1.0], [-(rate**2), -2.0 * damping * rate]])
    keep, late = expm(system * step), 2.0 * damping / rate
    out = np.empty_like(signal)
    left = np.zeros((2, signal.shape[1]))
    slopes = np.diff(signal, axis=0) / step
    before = np.zeros(signal.shape[1])
    for n, slope in enumerate(slopes):
        out[n] = signal[n] - late * before + left[0]
        # the line to settle to changes: y = u - late u', y' = u'
        left = left - np.stack([late * (before - slope), slope - before])
        left = keep @ left
        before = slope
    out[-1] = signal[-1] - late * before + left[0]
    return out


def _sine(a: Numbers, time: Array) -> Array:
    return np.asarray(a[0] * np.sin(2.0 * np.pi * a[1] * time + a[2]))[:, None]


def _hold(time: Array, signal: Array, seconds: float) -> Array:
    """Return a signal that is renewed now and then only."""
    step = time[1] - time[0]
    every = max(1, round(seconds / step))
    return np.asarray(signal[(np.arange(len(signal)) // every) * every])


INPUT_FORMS: dict[str, Form] = {
    "bias": lambda a, t, u, v: u + a[0],
    "gain": lambda a, t, u, v: u * (1.0 + a[0]),
    "drift": lambda a, t, u, v: u + a[0] * t[:, None],
    "dead_zone": lambda a, t, u, v: u - np.clip(u, -a[0], a[0]),
    "saturation": lambda a, t, u, v: np.clip(u, -a[0], a[0]),
    "lag": lambda a, t, u, v: lag(t, u, a[0]),
    "delay": lambda a, t, u, v: delay(t, u, a[0]),
    "backlash": lambda a, t, u, v: backlash(u, a[0]),
    "asymmetry": lambda a, t, u, v: u + a[0] * np.maximum(u, 0.0),
    "square": lambda a, t, u, v: u + a[0] * u**2,
    "cubic": lambda a, t, u, v: u + a[0] * u**3,
    "rate_limit": lambda a, t, u, v: rate_limit(t, u, a[0]),
    "quantisation": lambda a, t, u, v: a[0] * np.round(u / a[0]),
    "sample_hold": lambda a, t, u, v: _hold(t, u, a[0]),
    "ripple": lambda a, t, u, v: u * (1.0 + _sine(a, t)),
    # What follows is from textbooks of physics.
    "mode": lambda a, t, u, v: mode(t, u, a[1] / a[0], a[2]),
    "power": lambda a, t, u, v: u * np.abs(u / a[1]) ** a[0],
}

OUTPUT_FORMS: dict[str, Form] = {
    "bias": lambda a, t, y, v: y + a[0],
    "drift": lambda a, t, y, v: y + a[0] * t[:, None],
    "gain": lambda a, t, y, v: y * (1.0 + a[0]),
    "square": lambda a, t, y, v: y + a[0] * y**2,
    "lag": lambda a, t, y, v: lag(t, y, a[0]),
    "delay": lambda a, t, y, v: delay(t, y, a[0]),
    "saturation": lambda a, t, y, v: np.minimum(y, a[0]),
    "absolute": lambda a, t, y, v: y + a[0] * np.abs(y),
    "feed_through": lambda a, t, y, v: y + a[0] * v,
    "lagged_feed_through": lambda a, t, y, v: y + a[0] * lag(t, v, a[1], start=0.0 * v[0]),
    "hysteresis": lambda a, t, y, v: y + a[0] * hysteresis(t, v, a[1]),
    "hum": lambda a, t, y, v: y + _sine(a, t),
    "quantisation": lambda a, t, y, v: a[0] * np.round(y / a[0]),
    "sample_hold": lambda a, t, y, v: _hold(t, y, a[0]),
    "wave": lambda a, t, y, v: y + a[0] * np.sin(a[1] * v),
    "warburg": lambda a, t, y, v: (
        y
        + sum(
            a[0] * share * lag(t, v, a[1] * longer, start=0.0 * v[0])
            for share, longer in ((0.5, 1.0), (0.75, 5.0), (1.0, 20.0))
        )
    ),
    # What follows is from textbooks of physics.
    "cubic": lambda a, t, y, v: y + a[0] * y**3,
    "saturating": lambda a, t, y, v: y / (1.0 + a[0] * y),
    "mode": lambda a, t, y, v: mode(t, y, a[1] / a[0], a[2]),
}
