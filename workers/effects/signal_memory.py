"""Forms with memory, such as delays: their result depends on past values of a signal.

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
    """Samples of a signal, which is constant before the first and after the last sample."""

    times: FloatArray
    values: FloatArray
    interpolation: Interpolation = "linear"


def delay(signal: SampledSignal, seconds: float) -> SampledSignal:
    """Return the signal of some seconds ago; before its first sample, the signal is constant.

    Samples that are very close, as after a backlash, may get the same time by rounding when they
    are shifted. Then only the last of them is kept.
    """
    times, values = _changed("core_delay", signal, seconds)
    return SampledSignal(times, values, signal.interpolation)


def backlash(signal: SampledSignal, half_width: float) -> SampledSignal:
    """Return the signal after a backlash, which must be crossed at each change of direction.

    This is the play operator: out = clip(out before, s - k, s + k), starting at s. The result is
    exact for signals that are linear between their samples: where the backlash has been crossed and
    the output starts to move, a sample is inserted.
    """
    times, values = _changed("core_backlash", signal, half_width)
    return SampledSignal(times, values, signal.interpolation)


def rate_limit(signal: SampledSignal, fastest: float) -> SampledSignal:
    """Return the output of an actuator that follows the signal with a limited rate of change.

    out' = clip(s', -r, r) where out = s, and r sign(s - out) elsewhere, starting at s. The result
    is exact: a sample is inserted where the output reaches the signal. The output is linear between
    its samples, even if the signal is a zero-order hold.
    """
    return _followed(signal, fastest, float(signal.values[0]))


def rate_limit_from_rest(signal: SampledSignal, fastest: float) -> SampledSignal:
    """Return the output of such an actuator that starts at zero; see `rate_limit`."""
    return _followed(signal, fastest, 0.0)


def _followed(signal: SampledSignal, fastest: float, start: float) -> SampledSignal:
    """Return the output of `rate_limit` with a given start value."""
    if not math.isfinite(fastest):
        return signal
    held = signal.interpolation == "hold"
    return SampledSignal(*_changed("core_rate_limit", signal, held, start, fastest))


def _changed(function: str, signal: SampledSignal, *how: float) -> tuple[FloatArray, FloatArray]:
    """Call a function of the core, and return the times and values of the new signal."""
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
"""The functions with memory by their names in `EffectForm.memory`, in the order of `table.h`."""
