"""Forms that change a signal as a whole, because what they give depends on what it was before.

At an input they change its samples before the simulation, ahead of the effects that act while it
runs; at an output they change the record. Each is a function of a signal's times and values and
of the first coefficient of its form.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from workers.messages import FloatArray

Samples = tuple[FloatArray, FloatArray]


def delay(times: FloatArray, values: FloatArray, seconds: float) -> Samples:
    """The signal as it was some seconds ago; before its start it was as at its start."""
    return times + seconds, values


def backlash(times: FloatArray, values: FloatArray, half_width: float) -> Samples:
    """The signal behind a play, which it has to cross whenever it turns.

    The play operator, from sample to sample: out = clip(out before, s - k, s + k), starting at s.
    """
    followed, out = [], float(values[0])
    for value in values.tolist():
        out = min(max(out, value - half_width), value + half_width)
        followed.append(out)
    return times, np.array(followed)


MEMORIES: dict[str, Callable[[FloatArray, FloatArray, float], Samples]] = {
    "delay": delay,
    "backlash": backlash,
}
"""By the name that a form calls them."""
