"""The effects that act while a system runs: at rates of states and at parameters.

Every law is a function of its numbers ``a``, the time, two variables ``v`` and ``w``, and the
memory ``z`` of those that have one. Friction switches at a sixth or less of the speed at which a
smooth model of it would (a tanh as wide as 1 % of the speed's rms).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from closed_loop_benchmark.system import Array

Numbers = Sequence[float]
Value = Array | float
Law = Callable[[Numbers, float, Value, Value, Value], Value]
Memory = Callable[[Numbers, Value, Value], Value]


def _beyond(v: Value, limit: float) -> Value:
    """How far a variable is outside of plus or minus a limit."""
    return v - np.clip(v, -limit, limit)


def _signed_root(v: Value) -> Value:
    return np.sign(v) * np.sqrt(np.abs(v))


def _stribeck(a: Numbers, v: Value) -> Value:
    """Level, sharpness, width of the peak and its height over the level."""
    return a[0] * np.tanh(v / a[1]) * (1.0 + a[3] * np.exp(-((v / a[2]) ** 2)))


def _two_levels(a: Numbers, v: Value) -> Value:
    """Level forwards, sharpness, and the level backwards over that forwards."""
    switch = np.tanh(v / a[1])
    return a[0] * np.where(v > 0.0, switch, a[2] * switch)


def _bell(a: Numbers, v: Value) -> Value:
    """Height, centre and width."""
    return a[0] * np.exp(-(((v - a[1]) / a[2]) ** 2))


def _haldane(a: Numbers, v: Value) -> Value:
    """What inhibition by the substrate takes from growth after Monod.

    The share of it that acts, the half-saturation constant, the constant of inhibition.
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
    # What follows is in no library of forms.
    "cogging": lambda a, t, v, w, z: a[0] * np.sin(a[1] * z),
    "placed_friction": lambda a, t, v, w, z: a[0] * np.tanh(v / a[1]) * (1.0 + np.sin(a[2] * w)),
    "magnet": lambda a, t, v, w, z: a[0] * v * np.exp(-((v / a[1]) ** 2)),
    "wave": lambda a, t, v, w, z: a[0] * np.sin(a[1] * v),
    "bristle": lambda a, t, v, w, z: a[0] * z * (1.0 + a[2] * np.exp(-((v / a[3]) ** 2))),
    "one_way": lambda a, t, v, w, z: a[0] * np.maximum(v, 0.0) * np.tanh(v / a[1]),
    # What follows is from textbooks of physics; see `closed_loop_benchmark.effects`.
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
    # What follows is in no library of forms.
    "wave": lambda a, t, v, w, z: a[0] * np.sin(a[1] * v),
    "switch": lambda a, t, v, w, z: a[0] * float(t > a[1]),
    # What follows is from textbooks of physics.
    "periodic_time": lambda a, t, v, w, z: a[0] * np.sin(2.0 * np.pi * a[1] * t + a[2]),
    "saturating": lambda a, t, v, w, z: a[0] * v / (a[1] + v),
    "saturating_square": lambda a, t, v, w, z: a[0] * v**2 / (a[1] ** 2 + v**2),
    "inverse": lambda a, t, v, w, z: a[0] / (a[1] + np.abs(v)),
    "bell": lambda a, t, v, w, z: _bell(a, v),
    "haldane": lambda a, t, v, w, z: _haldane(a, v),
}
"""Relative changes of a parameter, about the point where it has its true value."""
