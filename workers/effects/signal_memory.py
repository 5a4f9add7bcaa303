"""Forms with memory, such as delays: they change a signal as a whole, from its past values.

At an input they change its samples before the simulation, ahead of the effects that act while it
runs; at an output they change the recorded outputs. Each is a function of a signal and of the first
coefficient of its form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

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
    times = signal.times + seconds
    kept = np.append(times[1:] > times[:-1], True)
    if kept.all():
        return signal._replace(times=times)
    return signal._replace(times=times[kept], values=signal.values[kept])


def backlash(signal: SampledSignal, half_width: float) -> SampledSignal:
    """Return the signal behind a play, which it has to cross whenever it turns.

    The play operator: out = clip(out before, s - k, s + k), starting at s. It is exact for signals
    that are linear between their samples: there is a further sample wherever the play is crossed,
    before which nothing has moved yet.
    """
    times, values = signal.times, signal.values
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
    return signal._replace(times=np.array(at), values=np.array(followed))


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


def _followed(signal: SampledSignal, fastest: float, out: float) -> SampledSignal:
    """Follow a signal at a limited rate, from a value on."""
    if not math.isfinite(fastest):
        return signal
    times, starts = signal.times.tolist(), signal.values.tolist()
    ends = starts[:-1] if signal.interpolation == "hold" else starts[1:]
    at, followed = [times[0]], [out]
    for (begin, end), start, stop in zip(pairwise(times), starts, ends, strict=False):
        for time, reached in _limited(out, begin, start, end, stop, fastest):
            at.append(time)
            followed.append(reached)
        out = followed[-1]
    behind = abs(starts[-1] - out)
    if fastest > 0.0 and times[-1] + behind / fastest > times[-1]:
        at.append(times[-1] + behind / fastest)
        followed.append(starts[-1])
    return SampledSignal(np.array(at), np.array(followed), "linear")


def _limited(
    out: float, begin: float, start: float, end: float, stop: float, fastest: float
) -> list[tuple[float, float]]:
    """Follow one straight line from a value: what is reached, where it is caught up with too."""
    gap, slope = start - out, (stop - start) / (end - begin)
    found: list[tuple[float, float]] = []
    if gap != 0.0:
        way = math.copysign(1.0, gap)
        closing = fastest - way * slope
        if closing * (end - begin) <= abs(gap):
            return [(end, out + way * fastest * (end - begin))]
        caught = begin + abs(gap) / closing
        start += slope * (caught - begin)
        if begin < caught < end:
            found.append((caught, start))
        begin, out = caught, start
    if abs(slope) <= fastest:
        return [*found, (end, stop)]
    return [*found, (end, out + math.copysign(fastest, slope) * (end - begin))]


MEMORIES: dict[str, Callable[[SampledSignal, float], SampledSignal]] = {
    "delay": delay,
    "backlash": backlash,
    "rate_limit": rate_limit,
    "rate_limit_from_rest": rate_limit_from_rest,
}
"""The functions with a memory, by the name that a form calls them."""
