"""Limits of one simulated signal over time, from a constraint of a config."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.config.reader import ConstraintSection, StepSection, TrackingSection
from cluster_est.config.time_base import snapped
from cluster_est.errors import ConfigError
from workers.messages import FloatArray, Output, SignalBound


def tracking_bands(
    section: ConstraintSection,
    tracking: TrackingSection,
    start: float,
    stop: float,
    measured: Sequence[Output],
) -> list[SignalBound]:
    """A band around the measured signal, where this experiment has it."""
    first, last = section.between or (start, stop)
    found = []
    for output in measured:
        inside = (output.times >= max(first, start)) & (output.times <= min(last, stop))
        if output.variable != section.signal or not inside.any():
            continue
        values = output.values[inside]
        off = tracking.absolute + tracking.relative * np.abs(values)
        nothing = np.full(len(values), np.inf)
        equal = tracking.side == "both" and not off.any()
        found.append(
            SignalBound(
                name=section.name or f"tracking {section.signal}",
                variable=section.signal,
                times=output.times[inside],
                lower=-nothing if tracking.side == "upper" else values - off,
                upper=nothing if tracking.side == "lower" else values + off,
                scale=section.scale or float(np.max(off)) or _magnitude(values, values),
                equality=equal,
            )
        )
    return found


def signal_bound(section: ConstraintSection, where: str, start: float, stop: float) -> SignalBound:
    """Make the bounds of one signal from its limits, an envelope or a final value.

    Raises
    ------
    ConfigError
        If the limits contradict each other, or hold at no time of the simulation.
    """
    first, last = _interval(section, where, start, stop)
    if section.final is not None:
        return _final(section, stop)
    if section.step_response is not None:
        _check_step(section.step_response, where)
    corners = np.array(_corners(section))
    corners = corners[(corners >= first) & (corners <= last)]
    times = np.union1d(np.linspace(first, last, section.samples), corners)
    if section.step_response is not None:
        lower, upper = _envelope(section.step_response, times)
    else:
        lower = _level(section.lower, times, -np.inf, f"{where}.lower")
        upper = _level(section.upper, times, np.inf, f"{where}.upper")
    _check_finite_somewhere(section, where, times, lower, upper)
    if not (lower <= upper).all():
        at = times[np.flatnonzero(lower > upper)[0]]
        raise ConfigError(
            f"{where}.lower: must not be above upper but is at {at:g} s; swap them, or use final "
            "for a value that must be met"
        )
    return SignalBound(
        name=section.name or section.signal,
        variable=section.signal,
        times=times,
        lower=lower,
        upper=upper,
        scale=section.scale or _magnitude(lower, upper),
    )


def snapped_bound(bound: SignalBound, onto: FloatArray) -> SignalBound:
    """Put the times of a bound on measured ones, from which they differ by rounding alone.

    Where two fall together, the tighter limits hold; the later ones, where those exclude each
    other, because limits jump there.
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


def _interval(
    section: ConstraintSection, where: str, start: float, stop: float
) -> tuple[float, float]:
    """Return the part of the simulation in which a limit holds."""
    first, last = section.between or (start, stop)
    first, last = max(first, start), min(last, stop)
    if section.between is not None and section.between[0] > section.between[1]:
        raise ConfigError(
            f"{where}.between: must be [from, to] but is {list(section.between)}; swap them"
        )
    if not first <= last:
        raise ConfigError(
            f"{where}.between: must overlap with the simulation, {start:g} to {stop:g} s, but is "
            f"{list(section.between or ())}; change one"
        )
    return first, last


def _check_step(step: StepSection, where: str) -> None:
    if step.settling_time < step.rise_time:
        raise ConfigError(
            f"{where}.step_response.settling_time: must not be before rise_time, "
            f"{step.rise_time:g} s, but is {step.settling_time:g} s; swap them"
        )
    if step.initial == step.final:
        raise ConfigError(
            f"{where}.step_response.initial: must not be the final value but both are "
            f"{step.final:g}; use lower and upper for a signal that stays where it is"
        )


def _corners(section: ConstraintSection) -> list[float]:
    """Times at which a limit bends or jumps."""
    step = section.step_response
    if step is not None:
        return _step_times(step)
    return [t for level in (section.lower, section.upper) for t, _ in level or []]


def _check_finite_somewhere(
    section: ConstraintSection, where: str, times: FloatArray, lower: FloatArray, upper: FloatArray
) -> None:
    """A limit that is nowhere is a mistake."""
    limits = {"lower": lower, "upper": upper, "step_response": lower}
    for key, limit in limits.items():
        if getattr(section, key) is not None and not np.isfinite(limit).any():
            raise ConfigError(
                f"{where}.{key}: must limit the signal at some time from {times[0]:g} to "
                f"{times[-1]:g} s but does not; move its times"
            )


def _final(section: ConstraintSection, stop: float) -> SignalBound:
    target, off = float(section.final or 0.0), section.tolerance
    return SignalBound(
        name=section.name or f"final {section.signal}",
        variable=section.signal,
        times=np.array([stop]),
        lower=np.array([target - off]),
        upper=np.array([target + off]),
        scale=section.scale or abs(target) or off or 1.0,
        equality=off == 0.0,
    )


def _level(
    points: list[tuple[float, float]] | None, times: FloatArray, none: float, where: str
) -> FloatArray:
    """A limit at each time: constant, or straight from point to point and none outside of them."""
    if points is None:
        return np.full(len(times), none)
    known, values = np.array(points).T
    if len(known) == 1:
        return np.full(len(times), values[0])
    if not (np.diff(known) >= 0.0).all():
        raise ConfigError(f"{where}: its times must not go back but do; sort the points")
    return np.asarray(np.interp(times, known, values, left=none, right=none))


def _step_times(step: StepSection) -> list[float]:
    """Return the times at which it begins, must have risen and must have settled."""
    return [step.time + since for since in (0.0, step.rise_time, step.settling_time)]


def _envelope(step: StepSection, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Limits of a step response, from the beginning of the step on."""
    begun, risen, settled = (times >= moment for moment in _step_times(step))
    low = np.where(risen, step.rise / 100.0, -step.undershoot / 100.0)
    low = np.where(settled, 1.0 - step.settling / 100.0, low)
    high = np.where(settled, 1.0 + step.settling / 100.0, 1.0 + step.overshoot / 100.0)
    height = step.final - step.initial
    sides = np.sort([step.initial + height * low, step.initial + height * high], axis=0)
    return np.where(begun, sides[0], -np.inf), np.where(begun, sides[1], np.inf)


def _magnitude(lower: FloatArray, upper: FloatArray) -> float:
    limits = np.concatenate([lower, upper])
    return float(np.max(np.abs(limits[np.isfinite(limits)]), initial=0.0)) or 1.0
