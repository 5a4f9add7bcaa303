"""Constraints of a config on parameters and on signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.config.choices import UserCode
from cluster_est.config.sections import Config, ConstraintSection, StepSection, TrackingSection
from cluster_est.errors import ConfigError
from cluster_est.problem.formulas import ParameterConstraint, parse_constraint
from workers.fmu.description import ModelDescription, nearest
from workers.messages import FloatArray, Output, SignalBound, UserFunction
from workers.messages.checks import told_apart


def tracking_bands(
    section: ConstraintSection,
    tracking: TrackingSection,
    start: float,
    stop: float,
    measured: Sequence[Output],
) -> list[SignalBound]:
    """Return a band around the measured signal, if this experiment contains it."""
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
            f"{where}.lower: must not be above upper, but is above it at {at:g} s; swap them, or "
            "use final for a value that the signal must have at the end"
        )
    return SignalBound(
        name=section.name or section.signal,
        variable=section.signal,
        times=times,
        lower=lower,
        upper=upper,
        scale=section.scale or _magnitude(lower, upper),
    )


def _interval(
    section: ConstraintSection, where: str, start: float, stop: float
) -> tuple[float, float]:
    """Return the part of the simulation in which a limit applies."""
    first, last = section.between or (start, stop)
    first, last = max(first, start), min(last, stop)
    if section.between is not None and section.between[0] > section.between[1]:
        raise ConfigError(
            f"{where}.between: must be [from, to] with from before to, but is "
            f"{list(section.between)}; swap them"
        )
    if not first <= last:
        raise ConfigError(
            f"{where}.between: must overlap the simulation, which runs from {start:g} to {stop:g} "
            f"s, but is {list(section.between or ())}; change one of the two"
        )
    return first, last


def _check_step(step: StepSection, where: str) -> None:
    if step.settling_time < step.rise_time:
        rise, settling = told_apart(step.rise_time, step.settling_time)
        raise ConfigError(
            f"{where}.step_response.settling_time: must not be before rise_time, {rise} s, but is "
            f"{settling} s; swap them"
        )
    if step.initial == step.final:
        raise ConfigError(
            f"{where}.step_response.initial: must differ from final, but both are {step.final:g}; "
            "use lower and upper for a signal that does not change"
        )


def _corners(section: ConstraintSection) -> list[float]:
    """Return the times at which a limit has a kink or a jump."""
    step = section.step_response
    if step is not None:
        return _step_times(step)
    return [t for level in (section.lower, section.upper) for t, _ in level or []]


def _check_finite_somewhere(
    section: ConstraintSection, where: str, times: FloatArray, lower: FloatArray, upper: FloatArray
) -> None:
    """Refuse a limit that is finite at no time."""
    limits = {"lower": lower, "upper": upper, "step_response": lower}
    for key, limit in limits.items():
        if getattr(section, key) is not None and not np.isfinite(limit).any():
            raise ConfigError(
                f"{where}.{key}: must limit the signal at some time between {times[0]:g} and "
                f"{times[-1]:g} s, but does not; move its times"
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
    """Return a limit at each time: constant, or linear between points and absent outside."""
    if points is None:
        return np.full(len(times), none)
    known, values = np.array(points).T
    if len(known) == 1:
        return np.full(len(times), values[0])
    if not (np.diff(known) >= 0.0).all():
        raise ConfigError(f"{where}: the times must not decrease, but they do; sort the points")
    return np.asarray(np.interp(times, known, values, left=none, right=none))


def _step_times(step: StepSection) -> list[float]:
    """Return the times of the step, of its rise and of its settling."""
    return [step.time + since for since in (0.0, step.rise_time, step.settling_time)]


def _envelope(step: StepSection, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the limits of a step response, from the time of the step on."""
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


_SIGNAL_KEYS = (
    *("lower", "upper", "step_response", "tracking", "final"),
    *("tolerance", "between", "samples", "scale", "experiments"),
)
_KEYS = {"expression": ("scale",), "signal": _SIGNAL_KEYS, "function": ("equality", "experiments")}
"""Keys that each kind of constraint may have."""


def parameter_constraints(
    config: Config, parameters: tuple[str, ...]
) -> tuple[ParameterConstraint, ...]:
    """Return the constraints on parameters.

    Raises
    ------
    ConfigError, ProblemError
        If a constraint has no kind or several kinds, or its expression cannot be parsed.
    """
    found: list[ParameterConstraint] = []
    measured = {name for experiment in config.experiments for name in experiment.outputs}
    for i, section in enumerate(config.constraints):
        where = f"constraints[{section.name or i}]"
        _check_kind(section, where, [e.id for e in config.experiments], measured)
        if section.expression:
            text, scale = section.expression, section.scale or 1.0
            key = f"{where}.expression"
            found += parse_constraint(text, parameters, key, section.name, scale)
    return tuple(found)


def check_signals(config: Config, description: ModelDescription) -> None:
    """Check that the FMU has the signals of all constraints.

    Raises
    ------
    ModelError
        If it lacks one. The message contains similar names.
    """
    for i, section in enumerate(config.constraints):
        if section.signal:
            description.variable(section.signal, f"constraints[{section.name or i}].signal")


def signal_bounds(
    config: Config, experiment: str, start: float, stop: float, measured: Sequence[Output]
) -> tuple[SignalBound, ...]:
    """Return the constraints on signals of one experiment, simulated from start to stop.

    Parameters
    ----------
    config
        A checked config.
    experiment, start, stop
        The experiment's id, and the simulated interval.
    measured
        Its outputs, around which there may be a band.

    Raises
    ------
    ConfigError
        If a constraint does not apply at any time in that interval.
    """
    found = []
    for i, section in enumerate(config.constraints):
        if not section.signal or experiment not in (section.experiments or [experiment]):
            continue
        where = f"constraints[{section.name or i}]"
        if section.tracking is None:
            found.append(signal_bound(section, where, start, stop))
        else:
            found += tracking_bands(section, section.tracking, start, stop, measured)
    return tuple(found)


def constraint_functions(
    config: Config, experiment: str, code: UserCode
) -> tuple[UserFunction, ...]:
    """Return the constraints that are Python functions, for one experiment."""
    return tuple(
        replace(
            code.function(s.function, f"constraints[{s.name or i}].function", equality=s.equality),
            label=s.name,
        )
        for i, s in enumerate(config.constraints)
        if s.function and experiment in (s.experiments or [experiment])
    )


def _check_kind(
    section: ConstraintSection, where: str, experiments: list[str], measured: set[str]
) -> None:
    kinds = [key for key in ("expression", "signal", "function") if getattr(section, key)]
    if len(kinds) != 1:
        has = " and ".join(kinds) or "none of them"
        raise ConfigError(
            f"{where}: must have exactly one of expression, signal and function, but has {has}; "
            "write one constraint for each"
        )
    _check_keys(section, kinds[0], where)
    _check_limits(section, where, measured)
    for name in section.experiments:
        if name not in experiments:
            raise ConfigError(
                f"{where}.experiments: there is no {name!r}{nearest(name, experiments)}"
            )


def _check_keys(section: ConstraintSection, kind: str, where: str) -> None:
    """Refuse a key that does not apply to this kind of constraint."""
    for key, value in section:
        default = ConstraintSection.model_fields[key].get_default(call_default_factory=True)
        if key not in ("name", kind, *_KEYS[kind]) and value != default:
            raise ConfigError(
                f"{where}.{key}: must be left out with {kind}, where it has no meaning; remove "
                "one of the two"
            )
    for key, other, fits in (("tolerance", "final", True), ("between", "final", False)):
        if getattr(section, key) and (section.final is not None) is not fits:
            word = "used with" if fits else "left out with"
            raise ConfigError(f"{where}.{key}: must be {word} {other}; change one of the two")


def _check_limits(section: ConstraintSection, where: str, measured: set[str]) -> None:
    """Check that a signal has limits of exactly one kind."""
    keys = ("lower", "upper", "step_response", "tracking", "final")
    given = [key for key in keys if getattr(section, key) is not None]
    if section.signal and not given:
        raise ConfigError(
            f"{where}.signal: must have a limit, but has none; add one of {', '.join(keys)}"
        )
    for key in given:
        if key in keys[2:] and len(given) > 1:
            raise ConfigError(
                f"{where}.{key}: must be the only limit of its constraint, but "
                f"{' and '.join(given)} are given; write a constraint for each kind of limit"
            )
    if section.tracking is not None and section.signal not in measured:
        raise ConfigError(
            f"{where}.signal: the band lies around a measured signal, but no experiment measures "
            f"{section.signal!r}{nearest(section.signal, sorted(measured))}"
        )
