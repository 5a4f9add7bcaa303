"""From a checked config to a problem: reads the FMU and the measured tables."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from cluster_est.config import Config, ExperimentSection, InputSection, find_file
from cluster_est.costs import COSTS
from cluster_est.data import Table, check_times, read_table
from cluster_est.errors import ConfigError, DataError, ModelError
from cluster_est.methods import ALIASES, METHODS, Method
from cluster_est.problem import Parameter, Problem
from cluster_est.resources import Resources
from cluster_est.runner import Budget
from workers.description import Description, describe, nearest
from workers.messages import (
    Experiment,
    FloatArray,
    Input,
    Interface,
    Model,
    Output,
    Solver,
    SolverName,
)


def build_problem(config: Config, base: Path) -> Problem:
    """Read everything that a config names.

    Parameters
    ----------
    config
        A checked config.
    base
        The folder that its paths start from.

    Raises
    ------
    ClusterEstError
        If a file is missing or wrong, or names do not fit together.
    """
    parameters = tuple(
        Parameter(
            name=name,
            start=section.start,
            lower=section.bounds[0],
            upper=section.bounds[1],
            scale=section.scale,
            fixed=section.fixed,
            variable=section.variable,
            per=section.per,
            unit=section.unit,
        )
        for name, section in config.parameters.items()
    )
    targets = [p.target for p in parameters]
    for name in config.values:
        if name in targets:
            raise ConfigError(
                f"values.{name}: is also a parameter; remove one of the two, or set "
                f"parameters.{name}.fixed = true"
            )
    model = _model(config, base, tuple(targets))
    tables: dict[Path, Table] = {}
    experiments = tuple(_experiment(e, config, base, tables) for e in config.experiments)
    problem = Problem(model, parameters, experiments, COSTS[config.cost.name]())
    problem.describe()
    return problem


def build_method(config: Config) -> Method:
    """The method with its options.

    Raises
    ------
    ConfigError
        If an option is unknown or of the wrong kind.
    """
    name = ALIASES.get(config.method.name, config.method.name)
    kind = METHODS[name]
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    hints = get_type_hints(kind)
    for key, value in config.method.options.items():
        where = f"method.options.{key}"
        if key not in fields:
            raise ConfigError(f"{where}: {name} has no such option{nearest(key, fields)}")
        _check_option(where, value, hints[key], fields[key].metadata.get("least"))
    return kind(**config.method.options)


def build_resources(config: Config) -> Resources:
    """Executor and budget."""
    return Resources(
        executor=config.executor.name,
        workers=config.executor.workers,
        address=config.executor.address,
        budget=Budget(config.budget.evaluations, config.budget.seconds),
    )


def _check_option(where: str, value: Any, hint: Any, least: float | None) -> None:
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            choices = ", ".join(repr(choice) for choice in get_args(hint))
            raise ConfigError(f"{where}: must be one of {choices} but is {value!r}")
        return
    allowed = (int, float) if hint is float else hint
    if not isinstance(value, allowed) or isinstance(value, bool) is not (hint is bool):
        raise ConfigError(f"{where}: must be of type {hint.__name__} but is {value!r}")
    if least is not None and not value >= least:
        raise ConfigError(f"{where}: must be at least {least:g} but is {value!r}")


def _model(config: Config, base: Path, targets: tuple[str, ...]) -> Model:
    path = find_file(config.model.fmu, base, config.data_folders, "model.fmu")
    archive = path.read_bytes()
    description = describe(path.name, archive)
    interface = _interface(config, description)
    return Model(path.name, archive, interface, _solver(config, description, interface), targets)


def _interface(config: Config, description: Description) -> Interface:
    wanted = config.model.interface
    offered = description.interfaces
    if wanted == "auto":
        simple = "model_exchange" in offered and description.event_indicators == 0
        return "model_exchange" if simple else offered[-1]
    if wanted not in offered:
        raise ModelError(
            f"model.interface: {description.file} must offer {wanted} but offers "
            f"{' and '.join(offered)}; choose that"
        )
    return wanted


def _solver(config: Config, description: Description, interface: Interface) -> Solver:
    section = config.model
    exchange = interface == "model_exchange"
    name: SolverName = "dormand_prince" if exchange else "fmu"
    if section.solver != "auto":
        name = section.solver
    if exchange is (name == "fmu"):
        usable = "dormand_prince or rk4" if exchange else "fmu"
        raise ConfigError(
            f"model.solver: must be {usable} for {interface} but is {name}; change one of the two"
        )
    if exchange and description.event_indicators > 0:
        raise ModelError(
            f"{description.file}: has {description.event_indicators} event indicators, which no "
            "solver here locates yet; use its co-simulation interface, or export it without events"
        )
    return Solver(name, section.step, section.rtol, section.atol, section.max_steps)


def _experiment(
    section: ExperimentSection, config: Config, base: Path, tables: dict[Path, Table]
) -> Experiment:
    where = f"experiment {section.id!r}"
    path = find_file(section.data, base, config.data_folders, f"{where}.data")
    if path not in tables:
        tables[path] = read_table(path, where)
    reader = _Reader(tables[path], section, where)
    times = reader.times()
    outputs = [reader.output(times, variable) for variable in section.outputs]
    start = float(times[0]) if section.start is None else section.start
    last = max((output.times[-1] for output in outputs if len(output.times)), default=times[-1])
    stop = float(last) if section.stop is None else section.stop
    if not start < stop:
        raise ConfigError(
            f"{where}: start must be before stop but they are {start:g} and {stop:g} s"
        )
    groups = {"": section.group} if isinstance(section.group, str) else section.group
    return Experiment(
        id=section.id,
        start=start,
        stop=stop,
        inputs=tuple(reader.input(times, name, given) for name, given in section.inputs.items()),
        outputs=tuple(_within(output, start, stop, section.windows) for output in outputs),
        values=tuple((config.values | section.values).items()),
        role=section.role,
        groups=tuple(groups.items()),
    )


class _Reader:
    """Columns of one experiment: the rows that it uses, scaled as it says."""

    def __init__(self, table: Table, section: ExperimentSection, where: str) -> None:
        self._table, self._section, self._where = table, section, where
        for name in section.columns:
            if name not in table.columns:
                raise DataError(
                    f"{where}.columns: {table.path} has no column {name!r}"
                    f"{nearest(name, table.columns)}"
                )
        for name in section.sigma:
            if name not in section.outputs:
                raise ConfigError(
                    f"{where}.sigma: {name!r} is none of its outputs"
                    f"{nearest(name, section.outputs)}"
                )
        for name, sigma in section.sigma.items():
            if not (sigma > 0.0 and np.isfinite(sigma)):
                raise ConfigError(f"{where}.sigma.{name}: must be positive but is {sigma:g}")

    def times(self) -> FloatArray:
        """The time of each used row."""
        section = self._section
        if section.time is not None:
            times = self._column(section.time)
        else:
            used = [*section.outputs.values()]
            count = len(self._column(used[0])) if used else 0
            times = np.arange(count, dtype=np.float64) * (section.sample_time or 1.0)
        if len(times) < 2:
            raise DataError(
                f"{self._where}: must use at least two rows of {self._table.path} but uses "
                f"{len(times)}; check rows"
            )
        first = self._table.first_row + (section.rows[0] if section.rows else 0)
        check_times(times, f"{self._where}: {self._table.path}, column {section.time!r}", first)
        return times

    def input(self, times: FloatArray, variable: str, given: str | InputSection) -> Input:
        column = given if isinstance(given, str) else given.column
        values = self._values(times, column)
        known = np.isfinite(values)
        if not known.any():
            raise DataError(
                f"{self._where}.inputs.{variable}: column {column!r} of {self._table.path} must "
                "hold at least one number but is empty"
            )
        interpolation = "linear" if isinstance(given, str) else given.interpolation
        return Input(variable, times[known], values[known], interpolation)

    def output(self, times: FloatArray, variable: str) -> Output:
        values = self._values(times, self._section.outputs[variable])
        measured = np.isfinite(values)
        sigma = self._section.sigma.get(variable, 1.0)
        return Output(variable, times[measured], values[measured], sigma)

    def _values(self, times: FloatArray, name: str) -> FloatArray:
        values = self._column(name)
        if len(values) != len(times):
            raise DataError(
                f"{self._where}: column {name!r} of {self._table.path} must have as many rows as "
                f"the time, {len(times)}, but has {len(values)}"
            )
        return values

    def _column(self, name: str) -> FloatArray:
        values = self._table.numbers(name, self._where)
        if self._section.rows is not None:
            first, last = self._section.rows
            if not 0 <= first < last <= len(values):
                raise ConfigError(
                    f"{self._where}.rows: must lie within the {len(values)} rows of "
                    f"{self._table.path} but is [{first}, {last}]"
                )
            values = values[first:last]
        change = self._section.columns.get(name)
        if change is None:
            return values
        mean = float(np.nanmean(values)) if change.demean else 0.0
        return (values - mean) * change.factor + change.offset


def _within(
    output: Output, start: float, stop: float, windows: list[tuple[float, float]]
) -> Output:
    """What was measured in the simulated interval and, if there are any, in a window."""
    keep = (output.times >= start) & (output.times <= stop)
    if windows:
        inside = [(output.times >= a) & (output.times <= b) for a, b in windows]
        keep &= np.any(inside, axis=0)
    return Output(output.variable, output.times[keep], output.values[keep], output.sigma)
