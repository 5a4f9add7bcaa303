"""Effects: laws that act while a system runs, and laws on complete signals.

Every law at a rate or a parameter is a function of its numbers ``a``, the time, two variables ``v``
and ``w``, and its memory ``z`` if it has one. The width of a friction switch is at most a sixth of
that of a smooth model (a tanh with a width of 1 % of the speed's rms).

Actuators act before the simulation and sensors after it. Their signals have one column for each
run, on a grid of constant step. Every form is a function of its numbers ``a``, the times, the
signal, and another signal ``v`` on which it may depend.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import expm

from closed_loop_benchmark.system import Array

Numbers = Sequence[float]
Value = Array | float
Law = Callable[[Numbers, float, Value, Value, Value], Value]
Memory = Callable[[Numbers, Value, Value], Value]


def _beyond(v: Value, limit: float) -> Value:
    """Return the distance of a variable from the interval from -limit to limit."""
    return v - np.clip(v, -limit, limit)


def _signed_root(v: Value) -> Value:
    return np.sign(v) * np.sqrt(np.abs(v))


def _stribeck(a: Numbers, v: Value) -> Value:
    """Arguments: level, sharpness, width of the peak and its height over the level."""
    return a[0] * np.tanh(v / a[1]) * (1.0 + a[3] * np.exp(-((v / a[2]) ** 2)))


def _two_levels(a: Numbers, v: Value) -> Value:
    """Arguments: forward level, sharpness, and ratio of the backward to the forward level."""
    switch = np.tanh(v / a[1])
    return a[0] * np.where(v > 0.0, switch, a[2] * switch)


def _bell(a: Numbers, v: Value) -> Value:
    """Arguments: height, centre and width."""
    return a[0] * np.exp(-(((v - a[1]) / a[2]) ** 2))


def _haldane(a: Numbers, v: Value) -> Value:
    """Reduction of Monod growth by substrate inhibition.

    Arguments: its active share, the half-saturation constant, the constant of inhibition.
    """
    plain = a[1] + v
    return a[0] * (plain / (plain + v**2 / a[2]) - 1.0)


RATE_LAWS: dict[str, Law] = {
    "constant": lambda a, t, v, w, z: a[0],
    "drift": lambda a, t, v, w, z: a[0] * t,
    "sine": lambda a, t, v, w, z: a[0] * np.sin(2.0 * np.pi * a[1] * t + a[2]),
    "linear": lambda a, t, v, w, z: a[0] * v,
    "viscous": lambda a, t, v, w, z: a[0] * v,
    "quadratic": lambda a, t, v, w, z: a[0] * v * np.abs(v),
    "cubic": lambda a, t, v, w, z: a[0] * v**3,
    "square": lambda a, t, v, w, z: a[0] * v**2,
    "coulomb": lambda a, t, v, w, z: a[0] * np.tanh(v / a[1]),
    "stribeck": lambda a, t, v, w, z: _stribeck(a, v),
    "dahl": lambda a, t, v, w, z: a[0] * z,
    "end_stop": lambda a, t, v, w, z: a[0] * _beyond(v, a[1]),
    "gap": lambda a, t, v, w, z: a[0] * _beyond(v, a[1]),
    "joint": lambda a, t, v, w, z: a[0] * np.clip(v, -a[1], a[1]),
    "hinge": lambda a, t, v, w, z: a[0] * np.maximum(v - a[1], 0.0),
    "square_root": lambda a, t, v, w, z: a[0] * np.sqrt(np.maximum(v, 0.0)),
    "leak": lambda a, t, v, w, z: a[0] * _signed_root(v),
    "product": lambda a, t, v, w, z: a[0] * v * w,
    "lagged": lambda a, t, v, w, z: a[0] * z,
    # The following forms are in no library.
    "cogging": lambda a, t, v, w, z: a[0] * np.sin(a[1] * z),
    "placed_friction": lambda a, t, v, w, z: a[0] * np.tanh(v / a[1]) * (1.0 + np.sin(a[2] * w)),
    "magnet": lambda a, t, v, w, z: a[0] * v * np.exp(-((v / a[1]) ** 2)),
    "wave": lambda a, t, v, w, z: a[0] * np.sin(a[1] * v),
    "bristle": lambda a, t, v, w, z: a[0] * z * (1.0 + a[2] * np.exp(-((v / a[3]) ** 2))),
    "one_way": lambda a, t, v, w, z: a[0] * np.maximum(v, 0.0) * np.tanh(v / a[1]),
    # The following forms are from textbooks of physics.
    "power": lambda a, t, v, w, z: a[0] * np.sign(v) * np.abs(v) ** a[1],
    "contact": lambda a, t, v, w, z: a[0] * np.maximum(v - a[1], 0.0) ** 1.5,
    "saturating": lambda a, t, v, w, z: a[0] * v / (a[1] + v),
    "exponential": lambda a, t, v, w, z: a[0] * (np.exp((v - a[2]) / a[1]) - 1.0),
    "fourth_powers": lambda a, t, v, w, z: a[0] * (v**4 - w**4),
    "periodic": lambda a, t, v, w, z: a[0] * np.sin(a[1] * v + a[2]),
    "pressed_friction": lambda a, t, v, w, z: a[0] * np.abs(w) * np.tanh(v / a[1]),
    "two_levels": lambda a, t, v, w, z: _two_levels(a, v),
    "constant_power": lambda a, t, v, w, z: a[0] * v / (v**2 + a[1] ** 2),
}

MEMORIES: dict[str, Memory] = {
    "dahl": lambda a, v, z: v / a[1] * (1.0 - z * np.sign(v)),
    "lagged": lambda a, v, z: (v - z) / a[1],
    "heating": lambda a, v, z: (v**2 - z) / a[1],
    "cogging": lambda a, v, z: v,
    "bristle": lambda a, v, z: v / a[1] * (1.0 - z * np.sign(v)),
}
"""Rates of the memories, which start at zero."""

PARAMETER_LAWS: dict[str, Law] = {
    "drift": lambda a, t, v, w, z: a[0] * (t - a[1]),
    "linear": lambda a, t, v, w, z: a[0] * (v - a[1]),
    "magnitude": lambda a, t, v, w, z: a[0] * (np.abs(v) - a[1]),
    "square": lambda a, t, v, w, z: a[0] * (v**2 - a[1]),
    "heating": lambda a, t, v, w, z: a[0] * (z - a[2]),
    # The following forms are in no library.
    "wave": lambda a, t, v, w, z: a[0] * np.sin(a[1] * v),
    "switch": lambda a, t, v, w, z: a[0] * float(t > a[1]),
    # The following forms are from textbooks of physics.
    "periodic_time": lambda a, t, v, w, z: a[0] * np.sin(2.0 * np.pi * a[1] * t + a[2]),
    "saturating": lambda a, t, v, w, z: a[0] * v / (a[1] + v),
    "saturating_square": lambda a, t, v, w, z: a[0] * v**2 / (a[1] ** 2 + v**2),
    "inverse": lambda a, t, v, w, z: a[0] / (a[1] + np.abs(v)),
    "bell": lambda a, t, v, w, z: _bell(a, v),
    "haldane": lambda a, t, v, w, z: _haldane(a, v),
}
"""Relative changes of a parameter, about the point at which it has its true value."""


Form = Callable[[Numbers, Array, Array, Array], Array]


def lag(time: Array, signal: Array, constant: float, start: Array | None = None) -> Array:
    """Return a signal after a first-order lag, exact for linear interpolation."""
    step = time[1] - time[0]
    keep, out = np.exp(-step / constant), np.empty_like(signal)
    out[0] = signal[0] if start is None else start
    behind = constant * np.diff(signal, axis=0) / step
    for n, shift in enumerate(behind):
        out[n + 1] = signal[n + 1] - shift + (out[n] - signal[n] + shift) * keep
    return out


def delay(time: Array, signal: Array, seconds: float) -> Array:
    """Return a delayed signal; before the start, it is constant."""
    columns = [np.interp(time - seconds, time, column) for column in signal.T]
    return np.column_stack(columns)


def backlash(signal: Array, half_width: float) -> Array:
    """Return a signal after a backlash."""
    out = np.empty_like(signal)
    out[0] = signal[0]
    for n in range(1, len(signal)):
        out[n] = np.clip(out[n - 1], signal[n] - half_width, signal[n] + half_width)
    return out


def rate_limit(time: Array, signal: Array, fastest: float) -> Array:
    """Return a signal with a limited rate of change."""
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
    """Return a signal after an oscillator with two states, at rest at the first value.

    It is exact for linear interpolation: the oscillator then has a linear particular solution, and
    the rest of its state rotates and decays.
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
        # the particular solution changes: y = u - late u', y' = u'
        left = left - np.stack([late * (before - slope), slope - before])
        left = keep @ left
        before = slope
    out[-1] = signal[-1] - late * before + left[0]
    return out


def _sine(a: Numbers, time: Array) -> Array:
    return np.asarray(a[0] * np.sin(2.0 * np.pi * a[1] * time + a[2]))[:, None]


def _hold(time: Array, signal: Array, seconds: float) -> Array:
    """Return a signal that is updated only at intervals."""
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
    # The following forms are from textbooks of physics.
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
    # The following forms are from textbooks of physics.
    "cubic": lambda a, t, y, v: y + a[0] * y**3,
    "saturating": lambda a, t, y, v: y / (1.0 + a[0] * y),
    "mode": lambda a, t, y, v: mode(t, y, a[1] / a[0], a[2]),
}
