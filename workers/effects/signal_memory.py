"""Forms with memory, such as delays: they change a signal as a whole, from its past values.

At an input, they change its samples before the simulation, and before the effects that act during
the simulation. At an output, they change the recorded values. Each form is a function of a signal
and of the form's first coefficient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from workers.core.library import core
from workers.messages import FloatArray, Interpolation


class SampledSignal(NamedTuple):
    """Samples of a signal, which keeps its first value before and its last value after them."""

    times: FloatArray
    values: FloatArray
    interpolation: Interpolation = "linear"


def delay(signal: SampledSignal, seconds: float) -> SampledSignal:
    """Return the signal as it was some seconds ago; before its start it was as at its start.

    Of samples so close that they fall on one time when it is moved, as behind a backlash, the last
    one is kept.
    """
    times, values = _changed("core_delay", signal, seconds)
    return SampledSignal(times, values, signal.interpolation)


def backlash(signal: SampledSignal, half_width: float) -> SampledSignal:
    """Return the signal behind a play, which it has to cross whenever it turns.

    The play operator: out = clip(out before, s - k, s + k), starting at s. It is exact for signals
    that are linear between their samples: there is a further sample wherever the play is crossed,
    before which nothing has moved yet.
    """
    times, values = _changed("core_backlash", signal, half_width)
    return SampledSignal(times, values, signal.interpolation)


def rate_limit(signal: SampledSignal, fastest: float) -> SampledSignal:
    """Return the signal of an actuator that follows it, but never changes faster than a rate.

    out' = clip(s', -r, r) where out = s, else r sign(s - out), starting at s. It is exact: there is
    a further sample wherever the signal is caught up with. What follows a signal that is held is
    linear between its samples.
    """
    return _followed(signal, fastest, float(signal.values[0]))


def rate_limit_from_rest(signal: SampledSignal, fastest: float) -> SampledSignal:
    """Return the same of an actuator that stands at zero at the start."""
    return _followed(signal, fastest, 0.0)


def _followed(signal: SampledSignal, fastest: float, start: float) -> SampledSignal:
    """Follow a signal at a limited rate, from a value on."""
    if not math.isfinite(fastest):
        return signal
    held = signal.interpolation == "hold"
    return SampledSignal(*_changed("core_rate_limit", signal, held, start, fastest))


def _changed(function: str, signal: SampledSignal, *how: float) -> tuple[FloatArray, FloatArray]:
    """Call a function of the core, and return the times and values that it has written."""
    given = [np.ascontiguousarray(each, np.float64) for each in (signal.times, signal.values)]
    made = np.zeros((2, 2 * len(signal.times) + 1))
    from_, to = ([each.ctypes.data for each in arrays] for arrays in (given, made))
    count = getattr(core(), function)(*from_, len(signal.times), *how, *to)
    return made[0, :count].copy(), made[1, :count].copy()


MEMORIES: dict[str, Callable[[SampledSignal, float], SampledSignal]] = {
    "delay": delay,
    "backlash": backlash,
    "rate_limit": rate_limit,
    "rate_limit_from_rest": rate_limit_from_rest,
}
"""The functions with a memory, by the name that a form calls them, in the order of `table.h`."""
