"""Objects that a config selects by name: method, cost, priors, resources, Python functions."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from cluster_est.config.sections import Config
from cluster_est.errors import ConfigError, ProblemError
from cluster_est.methods import METHOD_ALIASES, SEARCH_METHODS, Method
from cluster_est.plug_in import check_option
from cluster_est.problem.costs import COST_ALIASES, COSTS, Cost, TotalCost
from cluster_est.problem.priors import PRIORS, Prior
from cluster_est.running.resources import Resources
from workers.fmu.description import nearest
from workers.messages import Limits, UserFunction
from workers.messages.checks import shown
from workers.residuals.functions import load


def build_resources(config: Config) -> Resources:
    """Return the executor, limits and budget."""
    section = config.executor
    memory = float("inf") if section.memory is None else section.memory * 2.0**20
    return Resources(
        executor=section.name,
        workers=section.workers,
        address=section.address,
        budget=config.budget,
        limits=Limits(section.timeout, section.stall, memory, section.growth * 2.0**20),
        instances=section.instances,
    )


def build_method(config: Config) -> Method:
    """Return the method with its options.

    Raises
    ------
    ConfigError
        If an option is unknown or of the wrong type.
    """
    name = METHOD_ALIASES.get(config.method.name, config.method.name)
    return _with_options(SEARCH_METHODS[name], config.method.options, "method.options")


def build_cost(config: Config) -> Cost:
    """Return the cost with its options.

    Raises
    ------
    ConfigError
        If an option is unknown or of the wrong type, or if the total cost has no function.
    """
    name = COST_ALIASES.get(config.cost.name, config.cost.name)
    if name == TotalCost.name and not config.cost.function:
        raise ConfigError(
            f'cost.name: "{name}" needs a function that returns one number, but cost.function is '
            "missing; add it, or choose another cost"
        )
    return _with_options(COSTS[name], config.cost.options, "cost.options")


def build_prior(given: dict[str, Any], where: str) -> Prior | None:
    """Return the prior of a parameter; None if the config has none.

    Raises
    ------
    ConfigError
        If there is no such prior, or a key is missing, unknown or of the wrong type.
    """
    if not given:
        return None
    name = given.get("name")
    if not isinstance(name, str) or name not in PRIORS:
        said = f"is {shown(name)}" if "name" in given else "is missing"
        raise ConfigError(f"{where}.name: must be one of {', '.join(PRIORS)} but {said}")
    kind = PRIORS[name]
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if field.name not in given:
            raise ConfigError(f"{where}.{field.name} is missing; a prior {name!r} needs it")
    options = {key: value for key, value in given.items() if key != "name"}
    try:
        return _with_options(kind, options, where)
    except ProblemError as error:
        raise ConfigError(f"{where.removesuffix('prior')}{error}") from None


Kind = TypeVar("Kind", bound=Method | Cost | Prior)


def _with_options(kind: type[Kind], options: dict[str, Any], where: str) -> Kind:
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    hints = get_type_hints(kind)
    for key, value in options.items():
        if key not in fields:
            raise ConfigError(
                f"{where}.{key}: {kind.name} has no such option{nearest(key, fields)}"
            )
        check_option(f"{where}.{key}", value, hints[key], fields[key].metadata, ConfigError)
    return kind(**options)


_NAMED = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class UserCode:
    """Finds user-defined functions.

    Attributes
    ----------
    base
        Folder of the config, which may contain their files.
    allowed
        Whether user code may run.
    """

    base: Path
    allowed: bool

    def function(self, text: str, where: str, *, equality: bool = False) -> UserFunction:
        """Find the function "module:name".

        It is in MODULE.py in the folder of the config, whose text is sent to the workers, or in a
        module that is installed for each worker.

        Raises
        ------
        ConfigError
            If the text has another format, or code is not allowed.
        ModelError
            If there is no such function.
        """
        if not _NAMED.fullmatch(text):
            raise ConfigError(f'{where}: must be "module:name", but is {text!r}')
        if not self.allowed:
            raise ConfigError(
                f"{where}: {text!r} names Python code, which cluster-est runs only if it is "
                "allowed; if you trust this config and its code, add --allow-code"
            )
        module, name = text.split(":")
        file = self.base / f"{module}.py"
        source = ""
        if file.is_file():
            try:
                source = file.read_text(encoding="utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise ConfigError(
                    f"{where}: {file} cannot be read ({error}); correct the path, or the "
                    "permissions of the file"
                ) from error
        found = UserFunction(module, name, source, equality)
        load(found)
        return found
