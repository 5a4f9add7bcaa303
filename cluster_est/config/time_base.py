"""The time base: at which times simulated and measured signals are compared, and how it counts.

A simulation stands exactly on every time that is asked for, so only measured signals are ever
interpolated, and the number of residuals is the same for every point, whatever the solver does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from cluster_est.problem.held_out import within
from workers.messages import FloatArray, Interpolation, Output

TimeBase = Literal["measured", "union", "simulated", "both"]
Normalise = Literal["sigma", "max", "range"]
ROUNDING = 16.0 * float(np.finfo(float).eps)
"""Relative difference of times that are the same."""


def compared_at(
    outputs: Sequence[Output],
    interpolations: Sequence[Interpolation],
    time_base: TimeBase,
    simulated: FloatArray,
) -> tuple[Output, ...]:
    """Put outputs on a time base.

    Parameters
    ----------
    outputs
        As measured.
    interpolations
        Of each between its samples.
    time_base
        "measured": each at its own times. "union": each at the times of all of them. "simulated":
        each at `simulated`. "both": at the union of those. An output counts only from its first to
        its last sample.
    simulated : (n,)
        Times of the simulated time base.
    """
    if time_base == "measured":
        return tuple(outputs)
    union = np.unique(np.concatenate([np.zeros(0), *(output.times for output in outputs)]))
    simulated = snapped(simulated, union)
    wanted = {
        "union": union,
        "simulated": simulated,
        "both": np.union1d(union, simulated),
    }[time_base]
    pairs = zip(outputs, interpolations, strict=True)
    return tuple(_at(output, how, wanted) for output, how in pairs)


def snapped(times: FloatArray, onto: FloatArray) -> FloatArray:
    """Put times that differ from others by rounding alone on those.

    Else a sample would count twice, or a held one only after the next.
    """
    if not len(onto):
        return times
    after = np.minimum(np.searchsorted(onto, times), len(onto) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(times - onto[before]) < np.abs(times - onto[after])
    nearest = np.where(nearer, onto[before], onto[after])
    rounding = ROUNDING * np.max(np.abs(onto))
    return np.where(np.abs(times - nearest) <= rounding, nearest, times)


def _at(output: Output, interpolation: Interpolation, wanted: FloatArray) -> Output:
    times = output.times
    if not len(times):
        return output
    inside = wanted[(wanted >= times[0]) & (wanted <= times[-1])]
    if interpolation == "hold":
        values = output.values[np.searchsorted(times, inside, side="right") - 1]
    else:
        values = np.interp(inside, times, output.values)
    return replace(output, times=inside, values=values)


def counted(
    output: Output, first: float, last: float, windows: Sequence[tuple[float, float]]
) -> Output:
    """Keep the samples of an output from first to last and, if there are any, in windows."""
    keep = (output.times >= first) & (output.times <= last)
    if windows:
        keep &= within(output.times, windows)
    return replace(output, times=output.times[keep], values=output.values[keep])


def weighted(output: Output, normalise: Normalise, weight: float) -> Output:
    """Let an output's squares count as often as its weight says.

    Its residuals are divided by sigma, or by the measured signal's largest absolute value or range,
    and multiplied by the square root of the weight.
    """
    size, relative = output.sigma, output.relative_sigma
    if normalise != "sigma" and len(output.values):
        values = output.values
        size = float(np.ptp(values) if normalise == "range" else np.max(np.abs(values)))
        relative = 0.0
    root = float(np.sqrt(weight))
    return replace(output, sigma=(size or 1.0) / root, relative_sigma=relative / root)
