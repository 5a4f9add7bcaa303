"""From a checked config to a problem: reads the FMU and the measured tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cluster_est.config.constraints import check_signals, parameter_constraints
from cluster_est.config.effects import build_effects, build_shared_sensors, with_maps
from cluster_est.config.experiments import build_experiments
from cluster_est.config.options import build_cost, build_prior
from cluster_est.config.reader import Config, ParameterSection, read_config
from cluster_est.config.reading import find_file
from cluster_est.config.user_code import UserCode
from cluster_est.errors import ConfigError, ModelError
from cluster_est.problem.fmu_file import choose_interface
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.variables import check_value
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription, describe, describe_model
from workers.messages import (
    Interface,
    Model,
    Solver,
    SolverName,
)
from workers.messages.checks import as_path, check_flag, check_kind, shown
from workers.messages.model import check_solver


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
    path = as_path(path, "config", ConfigError)
    return build_problem(read_config(path, overrides), path.parent, allow_code=allow_code)


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
    advice = f"; use read_problem({shown(str(config))})" if isinstance(config, str | Path) else ""
    check_kind(config, Config, "config", ConfigError, advice)
    base = as_path(base, "base", ConfigError)
    check_flag(allow_code, "allow_code", ConfigError)
    config = with_maps(config)
    sections = config.parameters.items()
    targets = [each.variable or name for name, each in sections if not each.auxiliary]
    model = _model(config, base, tuple(targets))
    if config.units_of_files:
        _check_units(config.units_of_files, describe_model(model))
    parameters = tuple(_parameter(name, each) for name, each in sections)
    for name in config.values:
        if name in targets:
            raise ConfigError(
                f"{dotted('values', name)}: is also a parameter; remove one of the two, or set "
                f"{dotted('parameters', name)}.fixed = true"
            )
    # a sensor shows what all else has left
    effects = (*build_effects(tuple(config.effects)), *build_shared_sensors(config))
    code = UserCode(base, allowed=allow_code)
    experiments, tables = build_experiments(config, base, code)
    every = (*parameters, *(p for made in effects for p in made.parameters))
    constraints = (
        *parameter_constraints(config, tuple(p.name for p in every)),
        *(constraint for made in effects for constraint in made.constraints),
    )
    problem = Problem(
        model,
        every,
        experiments,
        build_cost(config),
        tuple(made.effect for made in effects),
        constraints,
        units=tuple(config.model.units.items()),
        tables=tables,
    )
    problem.describe()
    return problem


def _check_units(units: Mapping[str, str], description: ModelDescription) -> None:
    """Refuse values of files that are in another unit than the FMU's."""
    for name, unit in units.items():
        variable = description.variables.get(name)
        if variable is not None and variable.unit not in ("", unit):
            raise ConfigError(
                f"value_files: {name} must be in {variable.unit!r}, as in the FMU, but is in "
                f"{unit!r}; give it in that unit, as the FMU spells it: no number is converted"
            )


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
        prior=build_prior(section.prior, f"{dotted('parameters', name)}.prior"),
    )


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
            check_value(dotted("values", name), description.variables[name], value)
            structure[name] = int(value)
    description = describe(path.name, archive, structure)
    check_signals(config, description)
    interface = choose_interface(config.model.interface, description.interfaces)
    solver = _solver(config, interface)
    return Model(
        path.name,
        archive,
        interface,
        solver,
        targets,
        tuple(structure.items()),
        reset=config.model.reset,
        environment=tuple(config.model.environment.items()),
        working_folder=config.model.working_folder,
        stop_time=config.model.stop_time,
    )


def _solver(config: Config, interface: Interface) -> Solver:
    section = config.model
    exchange = interface == "model_exchange"
    name: SolverName = "dormand_prince" if exchange else "fmu"
    if section.solver != "auto":
        name = section.solver
    check_solver(interface, name)
    return Solver(name, section.step, section.rtol, section.atol, section.max_steps)
