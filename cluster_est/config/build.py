"""From a checked config to a problem: reads the FMU and the measured tables."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.config.constraints import check_signals, parameter_constraints
from cluster_est.config.effects import build_effects
from cluster_est.config.experiments import build_experiments
from cluster_est.config.messages import shown
from cluster_est.config.reader import Config, ParameterSection, read_config
from cluster_est.config.reading import find_file
from cluster_est.config.user_code import UserCode
from cluster_est.costs import ALIASES as COST_ALIASES
from cluster_est.costs import COSTS, Cost
from cluster_est.costs.total import TotalCost
from cluster_est.errors import ConfigError, EffectError, ModelError
from cluster_est.methods import ALIASES, METHODS, Method
from cluster_est.problem.problem import Parameter, Problem
from cluster_est.running.multistart import Multistart
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Budget
from cluster_est.uncertainty import UncertaintySettings
from workers.effects.site import parse_site
from workers.fmu.description import ModelDescription, describe, nearest
from workers.fmu.variable import ModelVariable
from workers.messages import (
    Interface,
    Limits,
    Model,
    Solver,
    SolverName,
    Value,
)

_OPTION_TYPES: dict[Any, tuple[Any, str]] = {
    float: ((int, float), "a number"),
    int: (int, "a whole number"),
    bool: (bool, "true or false"),
    str: (str, "text in quotes"),
}


def read_problem(
    path: str | Path, overrides: Sequence[str] = (), *, allow_code: bool = False
) -> Problem:
    """The problem that a config file describes, with its FMU and data read.

    Parameters
    ----------
    path
        The TOML file; paths in it start from its folder.
    overrides
        "key=value" with dots in the key, as on the command line.
    allow_code
        Whether Python functions that it names may run.

    Raises
    ------
    ClusterEstError
        If the config, a file or a name in it is wrong.
    """
    path = Path(path)
    return build_problem(read_config(path, list(overrides)), path.parent, allow_code=allow_code)


def build_problem(config: Config, base: Path, *, allow_code: bool = False) -> Problem:
    """Read everything that a config names.

    Parameters
    ----------
    config
        A checked config.
    base
        The folder that its paths start from.
    allow_code
        Whether Python functions that it names may run.

    Raises
    ------
    ClusterEstError
        If a file is missing or wrong, or names do not fit together.
    """
    parameters = tuple(_parameter(name, each) for name, each in config.parameters.items())
    targets = [p.target for p in parameters if not p.auxiliary]
    for name in config.values:
        if name in targets:
            raise ConfigError(
                f"values.{name}: is also a parameter; remove one of the two, or set "
                f"parameters.{name}.fixed = true"
            )
    effects, coefficients = build_effects(tuple(config.effects))
    model = _model(config, base, tuple(targets))
    code = UserCode(base, allowed=allow_code)
    experiments = build_experiments(config, base, code)
    every = (*parameters, *coefficients)
    constraints = parameter_constraints(config, tuple(p.name for p in every))
    problem = Problem(model, every, experiments, build_cost(config), effects, constraints)
    _check_roles(problem, problem.describe())
    return problem


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


def _parameter(name: str, section: ParameterSection) -> Parameter:
    return Parameter(
        name=name,
        start=0.0 if section.start is None else section.start,
        lower=section.bounds[0],
        upper=section.bounds[1],
        scale=section.scale,
        fixed=section.fixed,
        variable=section.variable,
        per=section.per,
        unit=section.unit,
        expression=section.expression,
        auxiliary=section.auxiliary,
    )


def build_settings(config: Config) -> LoopSettings:
    """Thresholds and sizes of a closed loop.

    Raises
    ------
    ConfigError
        If a site cannot be read.
    """
    section = config.closed_loop
    try:
        sites = [str(parse_site(text, "closed_loop.sites")) for text in section.sites]
    except EffectError as error:
        raise ConfigError(str(error)) from None
    return LoopSettings(
        forms=tuple(section.effects),
        sites=tuple(sites),
        **section.model_dump(exclude={"effects", "sites", "seed"}),
    )


def build_multistart(config: Config) -> Multistart:
    """From how many starts."""
    section = config.multistart
    return Multistart(
        n=section.n,
        sampler=section.sampler,
        points=tuple(section.points),
        screen=section.screen,
        at_once=section.at_once,
        patience=section.patience,
        same=section.same,
        seed=section.seed,
    )


def build_uncertainty(config: Config) -> UncertaintySettings:
    """Which intervals are computed by refits."""
    section = config.uncertainty
    return UncertaintySettings(
        profiles=tuple(section.profiles), **section.model_dump(exclude={"profiles"})
    )


def build_resources(config: Config) -> Resources:
    """Executor and budget."""
    return Resources(
        executor=config.executor.name,
        workers=config.executor.workers,
        address=config.executor.address,
        budget=Budget(config.budget.evaluations, config.budget.seconds),
        limits=_limits(config),
    )


def _limits(config: Config) -> Limits:
    section = config.executor
    memory = float("inf") if section.memory is None else section.memory * 2.0**20
    return Limits(section.timeout, section.stall, memory, section.growth * 2.0**20)


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


def _model(config: Config, base: Path, targets: tuple[str, ...]) -> Model:
    path = find_file(config.model.fmu, base, config.data_folders, "model.fmu")
    try:
        archive = path.read_bytes()
    except OSError as error:
        raise ModelError(f"model.fmu: {path} cannot be read ({error.strerror})") from error
    description = describe(path.name, archive)
    structure: dict[str, int] = {}
    for name, value in config.values.items():
        if description.variable(name, "values").causality == "structuralParameter":
            _check_value(f"values.{name}", description.variables[name], value)
            structure[name] = int(value)
    description = describe(path.name, archive, structure)
    check_signals(config, description)
    interface = _interface(config, description)
    solver = _solver(config, interface)
    return Model(
        path.name,
        archive,
        interface,
        solver,
        targets,
        tuple(structure.items()),
        renew=config.model.reset,
    )


def _interface(config: Config, description: ModelDescription) -> Interface:
    wanted = config.model.interface
    offered = description.interfaces
    if wanted == "auto":
        return "model_exchange" if "model_exchange" in offered else offered[-1]
    if wanted not in offered:
        unusable = [w for w in description.warnings if w.endswith("and is left out")]
        raise ModelError(
            f"model.interface: {description.file} must offer {wanted} but offers "
            f"{' and '.join(offered)}{''.join(f' ({w})' for w in unusable)}; choose that"
        )
    return wanted


def _solver(config: Config, interface: Interface) -> Solver:
    section = config.model
    exchange = interface == "model_exchange"
    name: SolverName = "dormand_prince" if exchange else "fmu"
    if section.solver != "auto":
        name = section.solver
    if exchange is (name == "fmu"):
        usable = "dormand_prince, rk4 or cvode" if exchange else "fmu"
        raise ConfigError(
            f"model.solver: must be {usable} for {interface} but is {name}; change one of the two"
        )
    return Solver(name, section.step, section.rtol, section.atol, section.max_steps)


def _check_roles(problem: Problem, description: ModelDescription) -> None:
    """Refuse variables that are given twice, and values that their type cannot hold."""
    targets = {p.target: p.name for p in problem.parameters}
    for experiment in problem.experiments:
        where = f"experiment {experiment.id!r}"
        driven = [given.variable for given in experiment.inputs]
        for name in driven:
            if name in targets:
                raise ConfigError(
                    f"{where}.inputs.{name}: must not be estimated too but is "
                    f"parameters.{targets[name]}; remove one of the two"
                )
        for name, value in experiment.values:
            if name in driven:
                raise ConfigError(
                    f"{where}.values.{name}: must not be an input of the same experiment but is; "
                    "remove one of the two"
                )
            _check_value(f"{where}.values.{name}", description.variables[name], value)
        for name in experiment.recorded:
            causality = description.variables[name].causality
            if causality in ("parameter", "input", "independent"):
                raise ConfigError(
                    f"{where}.outputs.{name}: must be a variable that "
                    f"{description.file} computes but is of causality {causality!r}; choose an "
                    "output or a local variable"
                )


def _check_value(where: str, variable: ModelVariable, value: Value) -> None:
    truth, text, kind = isinstance(value, bool), isinstance(value, str), variable.kind
    number = not truth and not text
    low, high, called = _whole_numbers(variable.type)
    fits = {
        "real": number,
        "integer": number and float(value).is_integer() and low <= float(value) <= high,
        "boolean": truth or (number and value in (0, 1)),
        "string": text,
    }
    if not fits.get(kind, False):
        must = {"integer": called, "boolean": "true or false", "string": "a text"}
        raise ConfigError(
            f"{where}: must be {must.get(kind, 'a number')}, because the variable is of type "
            f"{kind}, but is {shown(value)}"
        )


def _whole_numbers(type_: str) -> tuple[float, float, str]:
    """The least and the greatest of an FMI type, and what they are called."""
    bits = int(re.sub(r"\D", "", type_) or 64)
    most = min(bits, 53)  # beyond that, not every one is a float64
    if type_.startswith("U"):
        return 0.0, 2.0**most - 1, f"a whole number of {bits} bits that is not negative"
    return -(2.0 ** (most - 1)), 2.0 ** (most - 1) - 1, f"a whole number of {bits} bits"
