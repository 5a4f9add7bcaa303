"""Conversion of a checked config to a problem; reads the FMU and the measured tables.

Maps become parameters: a map is a table of values over points, which may be smooth and monotone.
`cluster_est.problem.effects.table_values` describes smoothness. Effects also add parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cluster_est.config.choices import UserCode, build_cost, build_prior
from cluster_est.config.constraints import check_signals, parameter_constraints
from cluster_est.config.experiment_keys import OutputSection
from cluster_est.config.experiments import build_experiments, find_file
from cluster_est.config.reader import config_folder, read_config
from cluster_est.config.sections import (
    Config,
    ConstraintSection,
    EffectSection,
    MapSection,
    ParameterSection,
)
from cluster_est.errors import ConfigError, ModelError
from cluster_est.problem.declared_effects import (
    DeclaredCoefficient,
    DeclaredEffect,
    MadeEffect,
    make_effect,
)
from cluster_est.problem.fmu_file import choose_interface
from cluster_est.problem.free_curves import UNBOUNDED, TableShape, ValueTable, check_table_name
from cluster_est.problem.gaps import split_at_gaps
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.sensors import shared_sensor
from cluster_est.problem.variables import check_value
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription, describe, describe_model
from workers.messages import Interface, Model, Solver, SolverName
from workers.messages.checks import as_path, check_flag, check_kind, shown
from workers.messages.model import check_solver


def read_problem(
    path: str | Path, overrides: Sequence[str] = (), *, allow_code: bool = False
) -> Problem:
    """Return the problem of a config file, including its FMU and data.

    Parameters
    ----------
    path
        The TOML file; paths in it are relative to its folder. For the config.toml of a run, they
        are relative to the folder of the run's original config.
    overrides
        "key=value" with dots in the key, as on the command line.
    allow_code
        Whether Python functions named in the config may run.

    Raises
    ------
    ClusterEstError
        If the config, a file or a name in it is wrong.
    """
    path = as_path(path, "config", ConfigError)
    base = config_folder(path)
    return build_problem(read_config(path, overrides), base, allow_code=allow_code)


def build_problem(config: Config, base: Path, *, allow_code: bool = False) -> Problem:
    """Return the problem of a config, including its FMU and data.

    Parameters
    ----------
    config
        A checked config.
    base
        Folder to which its paths are relative.
    allow_code
        Whether Python functions named in the config may run.

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
                f"{dotted('values', name)}: must not also be a parameter, but is; remove one of "
                f"the two, or set {dotted('parameters', name)}.fixed = true"
            )
    # sensors come last, because they show the result of all other effects
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
        gaps=tuple(gap for table in tables for gap in table.gaps),
    )
    problem.describe()
    return split_at_gaps(problem)


def _check_units(units: Mapping[str, str], description: ModelDescription) -> None:
    """Refuse values of files whose unit differs from the FMU's."""
    for name, unit in units.items():
        variable = description.variables.get(name)
        if variable is not None and variable.unit not in ("", unit):
            raise ConfigError(
                f"value_files: {name} must be in {variable.unit!r}, the unit in the FMU, but is in "
                f"{unit!r}; convert the number, because cluster-est does not, and write the unit "
                "as the FMU spells it"
            )


def _parameter(name: str, section: ParameterSection) -> Parameter:
    return Parameter(
        name,
        0.0 if section.start is None else section.start,
        **section.model_dump(exclude={"start", "prior"}),
        prior=build_prior(section.prior, f"{dotted('parameters', name)}.prior"),
    )


def _model(config: Config, base: Path, targets: tuple[str, ...]) -> Model:
    path = find_file(config.model.fmu, base, config.data_folders, "model.fmu")
    try:
        archive = path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"model.fmu: {path} cannot be read ({error.strerror}); check the path and "
            "its permissions"
        ) from error
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


def build_effects(sections: tuple[EffectSection, ...]) -> tuple[MadeEffect, ...]:
    """Return the effects of a config, each with its coefficients as parameters.

    Raises
    ------
    ConfigError
        If an effect has both a form and an equation, or neither, or an unknown coefficient.
    EffectError
        If there is no such form or site.
    """
    return tuple(make_effect(_declared(section)) for section in sections)


def build_shared_sensors(config: Config) -> tuple[MadeEffect, ...]:
    """Return effects for the outputs with a shared scale or offset, with their coefficients.

    Raises
    ------
    ConfigError
        If a scale or offset is shared in some experiments only, or contradicts another key.
    """
    outputs: dict[str, OutputSection] = {}
    for experiment in config.experiments:
        for name, given in experiment.outputs.items():
            where = f"experiment {experiment.id!r}.{dotted('outputs', name)}"
            _check_shared(where, given, outputs.setdefault(name, given))
    return tuple(
        shared_sensor(
            name, scale=given.free_scale == "shared", offset=given.free_offset == "shared"
        )
        for name, given in outputs.items()
        if "shared" in (given.free_scale, given.free_offset)
    )


def _check_shared(where: str, given: OutputSection, first: OutputSection) -> None:
    """Refuse a shared scale or offset that not all experiments have, or that has no influence."""
    for key in ("free_scale", "free_offset"):
        value, elsewhere = getattr(given, key), getattr(first, key)
        if value != elsewhere and "shared" in (value, elsewhere):
            raise ConfigError(
                f'{where}.{key}: must be "shared" in every experiment that has this output, or in '
                f"none of them, but is {value!r} here and {elsewhere!r} in an earlier experiment; "
                f"set {key} in experiment_defaults"
            )
        if value == "shared" and given.ordinal:
            raise ConfigError(
                f'{where}.{key}: must not be "shared" for an ordinal output, because only the '
                f"order of its values counts; remove {key} or ordinal"
            )
    if given.free_offset == "shared" and given.free_scale is True:
        raise ConfigError(
            f'{where}.free_offset: must not be "shared" if free_scale is true, because each '
            'experiment would scale it differently; make free_scale "shared" too'
        )


def _declared(section: EffectSection) -> DeclaredEffect:
    where = f"effects.{section.name or section.form}"
    return DeclaredEffect(
        section.name,
        section.site,
        section.form,
        section.equation,
        tuple(section.variables),
        {
            name: DeclaredCoefficient(
                **chosen.model_dump(exclude={"prior"}),
                prior=build_prior(chosen.prior, f"{where}.parameters.{name}.prior"),
            )
            for name, chosen in section.parameters.items()
        },
        section.reaction,
        TableShape(section.slope_change, section.monotone, section.bounds or UNBOUNDED),
    )


def with_maps(config: Config) -> Config:
    """Return the config with its maps converted to parameters and constraints.

    Raises
    ------
    ConfigError
        If a map contradicts itself, or has the name of a parameter.
    """
    if not config.maps:
        return config
    parameters, constraints = dict(config.parameters), list(config.constraints)
    for name, section in config.maps.items():
        table = _table(name, section)
        for key, parameter in _parameters(section, table).items():
            if key in parameters:
                raise ConfigError(
                    f"{dotted('maps', name)}: its value {key} must have a unique name, but there "
                    "is also a parameter of that name; rename one of the two"
                )
            parameters[key] = parameter
        if not section.fixed:
            constraints += [ConstraintSection(expression=text) for text in table.order()]
    return config.model_copy(
        update={"parameters": parameters, "constraints": constraints, "maps": {}}
    )


def _table(name: str, section: MapSection) -> ValueTable:
    """Return a map as a checked table of values."""
    where, count = dotted("maps", name), len(section.points)
    check_table_name(name, where, "NAME_1, NAME_2, ...")
    if len(section.variables) != count:
        raise ConfigError(
            f"{where}.variables: must have a name for each of the {count} points, but has "
            f"{len(section.variables)}; add or remove some"
        )
    if isinstance(section.start, list) and len(section.start) != count:
        raise ConfigError(
            f"{where}.start: must be one number, or one for each of the {count} points, but has "
            f"{len(section.start)}"
        )
    starts = section.start if isinstance(section.start, list) else [section.start] * count
    table = ValueTable(
        where,
        f"{name}_",
        tuple(f"{name}_{i}" for i in range(1, count + 1)),
        tuple(section.points),
        tuple(starts),
        TableShape(section.slope_change, section.monotone, section.bounds),
    )
    table.check()
    return table


def _parameters(section: MapSection, table: ValueTable) -> Mapping[str, ParameterSection]:
    """Return the parameters of a map, by their names in the config."""
    names = [name for name in table.values if name is not None]
    of_values = dict(zip(names, section.variables, strict=True))
    if section.slope_change is None or section.fixed:
        starts = zip(names, table.starts, strict=True)
        return {
            name: ParameterSection(
                start=start,
                bounds=section.bounds,
                fixed=section.fixed,
                variable=of_values[name],
                unit=section.unit,
            )
            for name, start in starts
        }
    found = {}
    for each in table.unknowns():
        known: dict[str, Any] = {"name": "normal", "mean": 0.0, "sd": each.sd}
        found[each.name] = ParameterSection(
            start=each.start,
            bounds=(each.lower, each.upper),
            auxiliary=True,
            prior={} if each.sd is None else known,
        )
    for name, text in table.expressions():
        found[name] = ParameterSection(expression=text, variable=of_values[name], unit=section.unit)
    return found
