"""From the experiments of a config to measured signals, constraints and time bases."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_est.config.constraints import constraint_functions, signal_bounds, snapped_bound
from cluster_est.config.reader import Config, ExperimentSection
from cluster_est.config.reading import ExperimentReader, find_file
from cluster_est.config.time_base import compared_at, counted, weighted
from cluster_est.config.user_code import UserCode
from cluster_est.errors import ConfigError
from cluster_est.problem.held_out import hold_out
from cluster_est.problem.tables.files import MeasuredTable, read_table
from cluster_est.problem.tables.measured import MeasuredColumns, TableSource, interval
from cluster_est.problem.tables.stand_ins import by_column
from cluster_est.settings import MOST_TIMES
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import Curve, Experiment, FloatArray, Input, Output


def build_experiments(
    config: Config, base: Path, code: UserCode
) -> tuple[tuple[Experiment, ...], tuple[TableSource, ...]]:
    """Read every experiment, and say from where.

    Parameters
    ----------
    config
        A checked config.
    base
        The folder that its paths start from.
    code
        Finds functions of the user's.

    Returns
    -------
    experiments, tables
        The experiments; the table of each one that has one over time, with what is used of it.

    Raises
    ------
    ClusterEstError
        If a file is missing or wrong, or names do not fit together.
    """
    _check_weights(config)
    tables: dict[Path, MeasuredTable] = {}
    found: list[Experiment] = []
    sources: list[TableSource] = []
    for section in config.experiments:
        experiment = _experiment(section, config, base, code, tables)
        found += (
            hold_out(experiment, windows) if (windows := section.test_windows) else [experiment]
        )
        sources += _source(section, config, base, tables)
    return tuple(found), tuple(sources)


def _source(
    section: ExperimentSection, config: Config, base: Path, tables: dict[Path, MeasuredTable]
) -> list[TableSource]:
    """Return the table of an experiment, if it has one over time, with the columns it uses."""
    named = (
        *((f"inputs.{name}", each.column) for name, each in section.inputs.items()),
        *((f"signals.{name}", each.column) for name, each in section.signals.items()),
        *((f"outputs.{name}", each.column) for name, each in section.outputs.items()),
    )
    if section.data is None or not named:
        return []
    path = find_file(section.data, base, config.data_folders, f"experiment {section.id!r}.data")
    rows = None if section.rows is None else (section.rows[0], section.rows[1])
    missing = tuple(section.missing)
    raw = MeasuredColumns(tables[path], section.id, rows, missing=missing)
    graded = {each.column for each in section.outputs.values() if each.ordinal}
    numbers = {column: raw.column(column) for _, column in named if column not in graded}
    looked_at = [(key, column) for key, column in named if column in numbers]
    times = () if section.time is None else (section.time,)
    used = (*times, *(column for _, column in named))
    return [
        TableSource(
            section.id,
            path,
            section.time,
            section.sample_time,
            rows,
            used,
            named,
            missing,
            by_column(numbers, looked_at, section.id),
        )
    ]


def _experiment(
    section: ExperimentSection,
    config: Config,
    base: Path,
    code: UserCode,
    tables: dict[Path, MeasuredTable],
) -> Experiment:
    where = f"experiment {section.id!r}"
    reader, times = _read(section, config, base, tables, where)
    measured: tuple[Output, ...] = ()
    inputs: tuple[Input, ...] = ()
    signals: tuple[Input, ...] = ()
    if reader is not None and len(times):
        measured = tuple(reader.output(times, variable) for variable in section.outputs)
        inputs = tuple(reader.input(times, name) for name in section.inputs)
        signals = tuple(reader.signal(times, name) for name in section.signals)
    start, stop = interval(section.start, section.stop, times, measured, where)
    function = config.cost.function
    return Experiment(
        id=section.id,
        start=start,
        stop=stop,
        inputs=inputs,
        outputs=_compared(section, config, measured, start, stop),
        values=tuple((config.values | section.values).items()),
        role=section.role,
        groups=tuple(section.group.items()),
        signals=signals,
        curve=None if reader is None else _curve(section, reader, start, stop, where),
        bounds=tuple(
            snapped_bound(bound, _within(times, start, stop))
            for bound in signal_bounds(config, section.id, start, stop, measured)
        ),
        cost_function=code.function(function, "cost.function") if function else None,
        constraint_functions=constraint_functions(config, section.id, code),
    )


def _read(
    section: ExperimentSection,
    config: Config,
    base: Path,
    tables: dict[Path, MeasuredTable],
    where: str,
) -> tuple[ExperimentReader | None, FloatArray]:
    """The experiment's table and its times; none where nothing is measured over time."""
    if section.data is None:
        return None, np.zeros(0)
    path = find_file(section.data, base, config.data_folders, f"{where}.data")
    if path not in tables:
        tables[path] = read_table(path, where)
    reader = ExperimentReader(tables[path], section, where)
    timed = section.outputs or section.inputs or section.signals
    return reader, reader.times() if timed else np.zeros(0)


def _within(times: FloatArray, start: float, stop: float) -> FloatArray:
    return times[(times >= start) & (times <= stop)]


def _compared(
    section: ExperimentSection,
    config: Config,
    measured: tuple[Output, ...],
    start: float,
    stop: float,
) -> tuple[Output, ...]:
    """Outputs on their time base, in their windows, with their weights."""
    cost = config.cost
    for output in measured:
        if output.detection_limit is not None or output.ordinal:
            _check_as_measured(output, section, config)
    inside = [counted(output, start, stop, ()) for output in measured]
    hows = [section.outputs[output.variable].interpolation for output in measured]
    found = compared_at(inside, hows, cost.time_base, _simulated(config, start, stop))
    result = []
    for output in found:
        given = section.outputs[output.variable].weight * section.weight
        weight = given * cost.weights.get(output.variable, 1.0)
        kept = counted(output, start + section.warm_up, stop, section.windows)
        result.append(weighted(kept, cost.normalise, weight))
    return tuple(result)


def _check_as_measured(output: Output, section: ExperimentSection, config: Config) -> None:
    """Refuse what would change the samples of an output with a detection limit, or of an ordinal.

    Or its noise: with a detection limit a weight too, for the noise then has a probability.
    """
    name = output.variable
    weight = section.outputs[name].weight * section.weight * config.cost.weights.get(name, 1.0)
    for key, value, usual in (
        ("cost.time_base", config.cost.time_base, "measured"),
        ("cost.normalise", config.cost.normalise, "sigma"),
        ("weight", 1.0 if output.ordinal else weight, 1.0),
    ):
        if value != usual:
            why = "it is ordinal" if output.ordinal else "there is a detection_limit"
            raise ConfigError(
                f"experiment {section.id!r}: output {name}: {key} must be {usual!r} where {why} "
                f"but is {value!r}; leave one of the two out"
            )


def _simulated(config: Config, start: float, stop: float) -> FloatArray:
    """Every `step` seconds, where the time base asks for that."""
    cost = config.cost
    if cost.time_base not in ("simulated", "both"):
        return np.zeros(0)
    step = cost.step or config.model.step
    if step is None:
        raise ConfigError(
            f"cost.step: must be given in seconds, because the time base is {cost.time_base!r}, "
            "but is not; add it, or model.step"
        )
    if not stop - start <= step * MOST_TIMES:
        raise ConfigError(
            f"cost.step: must leave at most {MOST_TIMES} times between {start:g} and {stop:g} s "
            f"but is {step:g} s; make it longer (without it, model.step counts)"
        )
    times: FloatArray = np.arange(start, stop + 1e-9 * (stop - start), step)
    return np.minimum(times, stop)


def _curve(
    section: ExperimentSection, reader: ExperimentReader, start: float, stop: float, where: str
) -> Curve | None:
    given = section.curve
    if given is None:
        return None
    for name in given.tolerance:
        if name not in given.columns:
            raise ConfigError(
                f"{where}.curve.tolerance.{name}: must be named as one of its columns but is not"
                f"{nearest(name, given.columns)}"
            )
    return Curve(
        variables=tuple(given.columns),
        points=reader.points(given.columns),
        times=np.unique(np.minimum(np.linspace(start, stop, given.samples), stop)),
        tolerances=tuple(given.tolerance.get(name, 0.0) for name in given.columns),
    )


def _check_weights(config: Config) -> None:
    named = {name for section in config.experiments for name in section.outputs}
    for name in config.cost.weights:
        if name not in named:
            raise ConfigError(
                f"{dotted('cost', 'weights', name)}: must be named as an output of some experiment "
                "but is not"
                f"{nearest(name, sorted(named))}"
            )
