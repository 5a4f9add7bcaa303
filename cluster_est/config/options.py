"""Method and cost of a config, with their options."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from cluster_est.config.messages import shown
from cluster_est.config.reader import Config
from cluster_est.costs import ALIASES as COST_ALIASES
from cluster_est.costs import COSTS, Cost
from cluster_est.costs.total import TotalCost
from cluster_est.errors import ConfigError
from cluster_est.methods import ALIASES, METHODS, Method
from workers.fmu.description import nearest

_OPTION_TYPES: dict[Any, tuple[Any, str]] = {
    float: ((int, float), "a number"),
    int: (int, "a whole number"),
    bool: (bool, "true or false"),
    str: (str, "text in quotes"),
}


def build_method(config: Config) -> Method:
    """The method with its options.

    Raises
    ------
    ConfigError
        If an option is unknown or of the wrong kind.
    """
    name = ALIASES.get(config.method.name, config.method.name)
    return _with_options(METHODS[name], config.method.options, "method.options")


def build_cost(config: Config) -> Cost:
    """The cost with its options; likewise."""
    name = COST_ALIASES.get(config.cost.name, config.cost.name)
    if name == TotalCost.name and not config.cost.function:
        raise ConfigError(
            f'cost.name: "{name}" needs a function that returns one number but cost.function is '
            "missing; add it, or choose another cost"
        )
    return _with_options(COSTS[name], config.cost.options, "cost.options")


Kind = TypeVar("Kind", bound=Method | Cost)


def _with_options(kind: type[Kind], options: dict[str, Any], where: str) -> Kind:
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    hints = get_type_hints(kind)
    for key, value in options.items():
        if key not in fields:
            raise ConfigError(
                f"{where}.{key}: {kind.name} has no such option{nearest(key, fields)}"
            )
        _check_option(f"{where}.{key}", value, hints[key], fields[key].metadata.get("least"))
    return kind(**options)


def _check_option(where: str, value: Any, hint: Any, least: float | None) -> None:
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            choices = ", ".join(repr(choice) for choice in get_args(hint))
            raise ConfigError(f"{where}: must be one of {choices} but is {shown(value)}")
        return
    allowed, called = _OPTION_TYPES.get(hint, (hint, hint.__name__))
    if not isinstance(value, allowed) or isinstance(value, bool) is not (hint is bool):
        raise ConfigError(f"{where}: must be {called} but is {shown(value)}")
    if hint is not str and not abs(value) < (1e100 if hint is float else 2**63):
        raise ConfigError(f"{where}: must be finite and of a usual size but is {shown(value)}")
    if least is not None and not value >= least:
        raise ConfigError(f"{where}: must be at least {least:g} but is {shown(value)}")
