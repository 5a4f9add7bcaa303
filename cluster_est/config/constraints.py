"""Constraints that a config names, on parameters and on signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cluster_est.config.reader import Config, ConstraintSection
from cluster_est.config.signal_limits import signal_bound, tracking_bands
from cluster_est.config.user_code import UserCode
from cluster_est.errors import ConfigError
from cluster_est.problem.formulas import ParameterConstraint, parse_constraint
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Output, SignalBound, UserFunction

_SIGNAL_KEYS = (
    *("lower", "upper", "step_response", "tracking", "final"),
    *("tolerance", "between", "samples", "scale", "experiments"),
)
_KEYS = {
    "expression": ("scale",),
    "signal": _SIGNAL_KEYS,
    "function": ("equality", "experiments"),
}
"""Of each kind of constraint."""


def parameter_constraints(
    config: Config, parameters: tuple[str, ...]
) -> tuple[ParameterConstraint, ...]:
    """Those on parameters.

    Raises
    ------
    ConfigError, ProblemError
        If a constraint is of no kind or of several, or its expression cannot be read.
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
    """Refuse constraints on signals that the FMU does not have.

    Raises
    ------
    ModelError
        With names that are close.
    """
    for i, section in enumerate(config.constraints):
        if section.signal:
            description.variable(section.signal, f"constraints[{section.name or i}].signal")


def signal_bounds(
    config: Config, experiment: str, start: float, stop: float, measured: Sequence[Output] = ()
) -> tuple[SignalBound, ...]:
    """Those on signals of one experiment, which is simulated from start to stop.

    Parameters
    ----------
    config
        A checked config.
    experiment, start, stop
        The experiment's id, and what is simulated of it.
    measured
        Its outputs, around which there may be a band.

    Raises
    ------
    ConfigError
        If nothing of it lies in that time.
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
    """Those that are Python functions, for one experiment."""
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
            f"{where}: must have one of expression, signal and function but has {has}"
        )
    _check_keys(section, kinds[0], where)
    _check_limits(section, where, measured)
    for name in section.experiments:
        if name not in experiments:
            raise ConfigError(
                f"{where}.experiments: there is no {name!r}{nearest(name, experiments)}"
            )


def _check_keys(section: ConstraintSection, kind: str, where: str) -> None:
    """A key that says nothing about a constraint of this kind is a mistake."""
    for key, value in section:
        default = ConstraintSection.model_fields[key].get_default(call_default_factory=True)
        if key not in ("name", kind, *_KEYS[kind]) and value != default:
            raise ConfigError(
                f"{where}.{key}: must be left out beside {kind}, where it means nothing; remove "
                "one of the two"
            )
    for key, other, fits in (("tolerance", "final", True), ("between", "final", False)):
        if getattr(section, key) and (section.final is not None) is not fits:
            word = "beside" if fits else "left out beside"
            raise ConfigError(f"{where}.{key}: must be {word} {other}; change one of the two")


def _check_limits(section: ConstraintSection, where: str, measured: set[str]) -> None:
    """A signal has limits of one kind."""
    keys = ("lower", "upper", "step_response", "tracking", "final")
    given = [key for key in keys if getattr(section, key) is not None]
    if section.signal and not given:
        raise ConfigError(f"{where}.signal: must have a limit but has none; add {', '.join(keys)}")
    for key in given:
        if key in keys[2:] and len(given) > 1:
            raise ConfigError(
                f"{where}.{key}: must stand alone but {' and '.join(given)} are there; make "
                "another constraint of the others"
            )
    if section.tracking is not None and section.signal not in measured:
        raise ConfigError(
            f"{where}.signal: must be measured in some experiment, because the band is around "
            f"what is measured, but {section.signal!r} is not"
            f"{nearest(section.signal, sorted(measured))}"
        )
