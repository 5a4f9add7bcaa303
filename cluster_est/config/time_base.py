"""The time base of outputs, and their weights.

The time base determines the times at which simulated and measured signals are compared. A
simulation stops exactly at each of these times, so only measured signals are interpolated. The
number of residuals is the same at every point, independent of the solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.config.sections import Normalise, TimeBase
from cluster_est.problem.held_out import within
from workers.messages import FloatArray, Interpolation, Output, SignalBound

ROUNDING_OF_TIMES = 16.0 * float(np.finfo(float).eps)
"""Largest relative difference of times that count as equal."""


def compared_at(
    outputs: Sequence[Output],
    interpolations: Sequence[Interpolation],
    time_base: TimeBase,
    simulated: FloatArray,
) -> tuple[Output, ...]:
    """Convert outputs to a time base.

    Parameters
    ----------
    outputs
        The outputs as measured.
    interpolations
        Interpolation of each output between its samples.
    time_base
        "measured": each at its own times. "union": each at the times of all outputs. "simulated":
        each at `simulated`. "both": at the union of those. An output counts only from its first to
        its last sample.
    simulated : (n,)
        Times of the simulated time base.
    """
    if time_base == "measured":
        return tuple(outputs)
    union = np.unique(np.concatenate([np.zeros(0), *(output.times for output in outputs)]))
    simulated = snapped(simulated, union)
    wanted = {"union": union, "simulated": simulated, "both": np.union1d(union, simulated)}[
        time_base
    ]
    pairs = zip(outputs, interpolations, strict=True)
    return tuple(_at(output, how, wanted) for output, how in pairs)


def snapped(times: FloatArray, onto: FloatArray) -> FloatArray:
    """Replace times that differ from times in `onto` only by rounding.

    Otherwise a sample would count twice, or a held value would take effect only at the next time.
    """
    if not len(onto):
        return times
    after = np.minimum(np.searchsorted(onto, times), len(onto) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(times - onto[before]) < np.abs(times - onto[after])
    closest = np.where(nearer, onto[before], onto[after])
    rounding = ROUNDING_OF_TIMES * np.max(np.abs(onto))
    return np.where(np.abs(times - closest) <= rounding, closest, times)


def snapped_bound(bound: SignalBound, onto: FloatArray) -> SignalBound:
    """Replace the times of a bound that differ from measured times only by rounding.

    If two times coincide, the tighter limits apply. If these contradict each other because the
    limits jump, the later limits apply.
    """
    times = snapped(bound.times, onto)
    first = np.flatnonzero(np.diff(times, prepend=-np.inf) > 0.0)
    last = np.append(first[1:], len(times)) - 1
    lower = np.maximum.reduceat(bound.lower, first)
    upper = np.minimum.reduceat(bound.upper, first)
    fits = lower <= upper
    return replace(
        bound,
        times=times[first],
        lower=np.where(fits, lower, bound.lower[last]),
        upper=np.where(fits, upper, bound.upper[last]),
    )


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
    """Return the samples of an output from first to last and, if there are windows, in windows."""
    keep = (output.times >= first) & (output.times <= last)
    if windows:
        keep &= within(output.times, windows)
    return replace(output, times=output.times[keep], values=output.values[keep])


def weighted(output: Output, normalise: Normalise, weight: float) -> Output:
    """Return an output with its weight in the sum of squares.

    Its residuals are divided by sigma, or by the measured signal's largest absolute value or range,
    and multiplied by the square root of the weight. A signal's size, or a weight without a sigma,
    says nothing about the noise.
    """
    size, relative = output.sigma, output.relative_sigma
    if normalise != "sigma" and len(output.values):
        values = output.values
        size = float(np.ptp(values) if normalise == "range" else np.max(np.abs(values)))
        relative = 0.0
    root = float(np.sqrt(weight))
    only_weight = normalise != "sigma" or (weight != 1.0 and not output.has_sigma)
    return replace(
        output,
        sigma=(size or 1.0) / root,
        relative_sigma=relative / root,
        sigma_known=output.sigma_known and not only_weight,
    )
