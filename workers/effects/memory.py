"""Forms with memory, such as delays: they change a signal as a whole, from its past values.

At an input they change its samples before the simulation, ahead of the effects that act while it
runs; at an output they change the recorded outputs. Each is a function of a signal's times and
values, and of the first coefficient of its form.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from workers.messages import FloatArray

Samples = tuple[FloatArray, FloatArray]


def delay(times: FloatArray, values: FloatArray, seconds: float) -> Samples:
    """The signal as it was some seconds ago; before its start it was as at its start."""
    return times + seconds, values


def backlash(times: FloatArray, values: FloatArray, half_width: float) -> Samples:
    """The signal behind a play, which it has to cross whenever it turns.

    The play operator: out = clip(out before, s - k, s + k), starting at s. It is exact for signals
    that are linear between their samples: there is a further sample wherever the play is crossed,
    before which nothing has moved yet.
    """
    at, followed = [float(times[0])], [float(values[0])]
    before, out = at[0], float(values[0])
    last = out
    for time, value in zip(times[1:].tolist(), values[1:].tolist(), strict=True):
        new = min(max(out, value - half_width), value + half_width)
        if new != out:
            contact = out + math.copysign(half_width, value - last)
            crossed = before + (time - before) * (contact - last) / (value - last)
            if before < crossed < time:
                at.append(crossed)
                followed.append(out)
        at.append(time)
        followed.append(new)
        before, last, out = time, value, new
    return np.array(at), np.array(followed)


MEMORIES: dict[str, Callable[[FloatArray, FloatArray, float], Samples]] = {
    "delay": delay,
    "backlash": backlash,
}
"""By the name that a form calls them."""
