"""Conversion of a config's experiments to measured signals, constraints and time bases."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_est.config.choices import UserCode
from cluster_est.config.constraints import constraint_functions, signal_bounds
from cluster_est.config.experiment_keys import ExperimentSection
from cluster_est.config.sections import Config
from cluster_est.config.time_base import compared_at, counted, snapped_bound, weighted
from cluster_est.errors import ConfigError
from cluster_est.problem.held_out import hold_out
from cluster_est.problem.tables.cells import is_switch
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.gaps import RecordGap, output_gaps
from cluster_est.problem.tables.grades import with_grades
from cluster_est.problem.tables.measured import (
    Clock,
    ColumnChange,
    MeasuredColumns,
    interval,
    without_samples,
)
from cluster_est.problem.tables.measured_table import MeasuredTable, Reading
from cluster_est.problem.tables.several_files import join_files, timed_files
from cluster_est.problem.tables.sources import TableSource
from cluster_est.problem.tables.stand_ins import by_column
from cluster_est.problem.tables.times import JOINT
from cluster_est.settings import MOST_TIMES
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import (
    Curve,
    Experiment,
    FloatArray,
    Input,
    Output,
)

Tables = dict[tuple[Path, Reading], MeasuredTable]
"""Tables that were read, once for each file and way of reading."""


def build_experiments(
    config: Config, base: Path, code: UserCode
) -> tuple[tuple[Experiment, ...], tuple[TableSource, ...]]:
    """Read all experiments, and return them with their tables.

    Parameters
    ----------
    config
        A checked config.
    base
        Folder to which its paths are relative.
    code
        Finds user-defined functions.

    Returns
    -------
    experiments, tables
        The experiments; the table of each experiment with signals over time, with the used columns.

    Raises
    ------
    ClusterEstError
        If a file is missing or wrong, or names do not fit together.
    """
    _check_weights(config)
    tables: Tables = {}
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
    section: ExperimentSection, config: Config, base: Path, tables: Tables
) -> list[TableSource]:
    """Return the table of an experiment with signals over time, with the columns it uses."""
    named = (
        *((f"inputs.{name}", each.column) for name, each in section.inputs.items()),
        *((f"signals.{name}", each.column) for name, each in section.signals.items()),
        *((f"outputs.{name}", each.column) for name, each in section.outputs.items()),
    )
    if section.data is None or not named:
        return []
    where = f"experiment {section.id!r}"
    table = _table(section, config, base, tables, where)
    missing = tuple(section.missing)
    raw = MeasuredColumns(table, section.id, section.rows, missing=missing)
    graded = {each.column for each in section.outputs.values() if each.ordinal}
    numbers = {column: raw.column(column) for _, column in named if column not in graded}
    looked_at = [(key, column) for key, column in named if column in numbers]
    times = () if section.time is None else tuple(section.time.split(JOINT))
    used = (*times, *(table.resolved(column) for _, column in named))
    changed, notes = replace(raw, changes=_changes(section, table)), list(table.notes)
    clock = None if section.time is None else changed.clock(section.time)
    if clock is not None and clock.said:
        notes.append(clock.said)
    dated = table.dated or (clock is not None and clock.origin is not None)
    found = by_column(numbers, looked_at, section.id)
    source = TableSource(
        section.id, Path(table.path), section.time, section.sample_time, section.rows, used,
        named, missing, found, table.reading, _test(section), tuple(notes),
        _units(table, used), _output_gaps(changed, section),
        tuple((f"inputs.{n}.time", each.time) for n, each in section.inputs.items() if each.time),
        tuple((name, changed.unit(each.column)) for name, each in section.signals.items()),
        _switches(table, section), dated,
    )  # fmt: skip
    return [source]


def _switches(table: MeasuredTable, section: ExperimentSection) -> tuple[str, ...]:
    """Return the columns of inputs with words or truth values, without a factor."""
    columns = {each.column: table.resolved(each.column) for each in section.inputs.values()}
    return tuple(
        column
        for column, own in columns.items()
        if is_switch(table.columns[own])
        and (
            column not in section.columns
            or "factor" not in section.columns[column].model_fields_set
        )
    )


def _begin(columns: MeasuredColumns, times: FloatArray, section: ExperimentSection) -> float:
    """Return the start of a record: its first row, or the first row with any value."""
    inputs = [each.column for each in section.inputs.values()]
    rest = section.outputs, section.signals
    others = [each.column for given in rest for each in given.values()]
    return columns.empty_until(times, inputs, others)


def _output_gaps(columns: MeasuredColumns, section: ExperimentSection) -> tuple[RecordGap, ...]:
    """Return the gaps in which outputs were not measured, apart from the user's windows."""
    if not section.outputs:
        return ()
    counted = next(iter(section.outputs.values())).column
    times = columns.times(section.time, section.sample_time, counted)
    outputs = [_output(columns, times, section, name) for name in section.outputs]
    begin = _begin(columns, times, section) if section.start is None else None
    return output_gaps(section.id, outputs, times, begin, section.stop)


def _units(table: MeasuredTable, used: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return the units of columns in the file, by the columns' names."""
    return tuple((name, table.units[name]) for name in used if table.units.get(name))


def _changes(section: ExperimentSection, table: MeasuredTable) -> dict[str, ColumnChange]:
    """Return the changes of columns; times of several files were changed when these were joined."""
    joined = (section.time or "", *table.clocks.values()) if table.files else ()
    return dict.fromkeys(joined, ColumnChange()) | {
        name: ColumnChange(each.factor, each.offset, each.demean, each.late)
        for name, each in section.columns.items()
        if name not in joined
    }


def _test(section: ExperimentSection) -> tuple[str, str] | None:
    """Return the column that distinguishes tests, and its value for this test."""
    if section.split_by is None or section.split_value is None:
        return None
    return section.split_by, section.split_value


def _table(
    section: ExperimentSection, config: Config, base: Path, tables: Tables, where: str
) -> MeasuredTable:
    """Return the table of an experiment; each file is read once for each way of reading."""
    names = section.data if isinstance(section.data, list) else [section.data or ""]
    found = []
    for name in names:
        key = (find_file(name, base, config.data_folders, f"{where}.data"), reading_of(section))
        if key not in tables:
            tables[key] = read_table(key[0], where, reading=key[1])
        found.append(tables[key])
    test = _test(section)
    if len(found) > 1:
        change = section.columns.get(section.time or "")
        scale = (None, 0.0) if change is None else (change.factor, change.offset)
        time = section.time or ""
        return join_files(timed_files(found, time, where, scale), time)
    return found[0] if test is None else found[0].part(*test, where)


def reading_of(section: ExperimentSection) -> Reading:
    """Return the options for reading an experiment's file."""
    given = section.model_dump(include=set(vars(Reading())))
    found = {key: value for key, value in given.items() if value is not None}
    if "long" in found:
        found["long"] = (found["long"]["names"], found["long"]["values"])
    return Reading(**found)


def _experiment(
    section: ExperimentSection,
    config: Config,
    base: Path,
    code: UserCode,
    tables: Tables,
) -> Experiment:
    where = f"experiment {section.id!r}"
    columns, times = _read(section, config, base, tables, where)
    measured: tuple[Output, ...] = ()
    inputs: tuple[Input, ...] = ()
    signals: tuple[Input, ...] = ()
    if columns is not None and len(times):
        measured = tuple(_output(columns, times, section, name) for name in section.outputs)
        inputs, signals = (
            tuple(
                columns.driving(
                    times,
                    name,
                    each.column,
                    each.interpolation,
                    key,
                    Clock(section.time, each.time),
                )
                for name, each in given.items()
            )
            for key, given in (("inputs", section.inputs), ("signals", section.signals))
        )
    begin = section.start
    if begin is None and columns is not None and len(times):
        begin = _begin(columns, times, section)
    start, stop = interval(begin, section.stop, times, measured, where)
    function = config.cost.function
    return Experiment(
        id=section.id,
        start=start,
        stop=stop,
        inputs=inputs,
        outputs=_compared(section, config, measured, start, stop),
        values=tuple((config.values | section.values).items()),
        role=section.role,
        gaps=section.gaps,
        groups=tuple(section.group.items()),
        signals=signals,
        curve=None if columns is None else _curve(section, columns, start, stop, where),
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
    tables: Tables,
    where: str,
) -> tuple[MeasuredColumns | None, FloatArray]:
    """Return the experiment's table and its times; none if nothing is measured over time."""
    if section.data is None:
        return None, np.zeros(0)
    table = _table(section, config, base, tables, where)
    missing = tuple(section.missing)
    columns = MeasuredColumns(table, where, section.rows, _changes(section, table), missing)
    of_signals = (section.outputs, section.inputs, section.signals)
    named = [each.column for given in of_signals for each in given.values()]
    if not named:
        return columns, np.zeros(0)
    return columns, columns.times(section.time, section.sample_time, named[0])


def _output(
    columns: MeasuredColumns, times: FloatArray, section: ExperimentSection, variable: str
) -> Output:
    """Return a measured output."""
    how = section.outputs[variable]
    if isinstance(how.ordinal, list):
        columns = with_grades(columns, variable, how.column, how.ordinal)
    sigma, relative = section.sigma.get(variable, 1.0), section.relative_sigma.get(variable, 0.0)
    clock = Clock(section.time, how.time)
    found = columns.output(times, variable, how.column, sigma, relative, clock)
    where = f"experiment {section.id!r}.{dotted('left_out', variable)}"
    return replace(
        without_samples(found, section.left_out.get(variable, ()), where),
        free_scale=how.free_scale is True,  # shared scales and offsets are effects
        free_offset=how.free_offset is True,
        detection_limit=how.detection_limit,
        ordinal=how.ordinal is not False,
        sigma_known=section.sigma_known,
    )


def _within(times: FloatArray, start: float, stop: float) -> FloatArray:
    return times[(times >= start) & (times <= stop)]


def _compared(
    section: ExperimentSection,
    config: Config,
    measured: tuple[Output, ...],
    start: float,
    stop: float,
) -> tuple[Output, ...]:
    """Return outputs on their time base, in their windows, with their weights."""
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
    """Refuse options that would change the samples of a censored or ordinal output.

    Options that change the noise are refused too. With a detection limit, this includes a weight,
    because the residuals depend on the probability of the noise.
    """
    name = output.variable
    weight = section.outputs[name].weight * section.weight * config.cost.weights.get(name, 1.0)
    for key, value, usual in (
        ("cost.time_base", config.cost.time_base, "measured"),
        ("cost.normalise", config.cost.normalise, "sigma"),
        ("weight", 1.0 if output.ordinal else weight, 1.0),
    ):
        if value != usual:
            kind = "an ordinal output" if output.ordinal else "an output with detection_limit"
            raise ConfigError(
                f"experiment {section.id!r}: output {name}: {key} must be {usual!r} for {kind}, "
                f"but is {value!r}; leave one of the two out"
            )


def _simulated(config: Config, start: float, stop: float) -> FloatArray:
    """Return the times at every `step` seconds, if the time base requires them."""
    cost = config.cost
    if cost.time_base not in ("simulated", "both"):
        return np.zeros(0)
    step = cost.step or config.model.step
    if step is None:
        raise ConfigError(
            "cost.step is missing, and so is model.step; add one of them in seconds, because the "
            f"time base is {cost.time_base!r}"
        )
    if not stop - start <= step * MOST_TIMES:
        raise ConfigError(
            f"cost.step: must leave at most {MOST_TIMES} times between {start:g} and {stop:g} s, "
            f"but is {step:g} s; make it longer (without cost.step, model.step is used)"
        )
    times: FloatArray = np.arange(start, stop + 1e-9 * (stop - start), step)
    return np.minimum(times, stop)


def _curve(
    section: ExperimentSection, columns: MeasuredColumns, start: float, stop: float, where: str
) -> Curve | None:
    given = section.curve
    if given is None:
        return None
    for name in given.tolerance:
        if name not in given.columns:
            raise ConfigError(
                f"{where}.curve.tolerance.{name}: must be one of the names in curve.columns, but "
                f"is not{nearest(name, given.columns)}"
            )
    return Curve(
        variables=tuple(given.columns),
        points=columns.points(given.columns.values()),
        times=np.unique(np.minimum(np.linspace(start, stop, given.samples), stop)),
        tolerances=tuple(given.tolerance.get(name, 0.0) for name in given.columns),
    )


def _check_weights(config: Config) -> None:
    named = {name for section in config.experiments for name in section.outputs}
    for name in config.cost.weights:
        if name not in named:
            raise ConfigError(
                f"{dotted('cost', 'weights', name)}: must be an output of at least one experiment, "
                f"but is not{nearest(name, sorted(named))}"
            )


def find_file(name: str, base: Path, folders: list[str], where: str) -> Path:
    """Look for a file in the folder of the config, then in the data folders.

    Raises
    ------
    ConfigError
        If none of them contains it; the message lists all of them.
    """
    tried = []
    for folder in [".", *folders]:
        beside, file = os.path.expandvars(folder), os.path.expandvars(name)
        if "$" in beside + file:
            tried.append(f"{os.path.join(beside, file)} (which is not set)")
            continue
        try:
            candidate = base / Path(beside).expanduser() / Path(file).expanduser()
            if candidate.is_file():
                return candidate
            shown = os.path.normpath(candidate)
            tried.append(f"{shown} (a folder)" if candidate.is_dir() else shown)
        except (OSError, RuntimeError) as error:  # too long, not permitted, unknown user
            tried.append(f"{file} ({error})")
    raise ConfigError(
        f"{where}: there is no file {name!r}; looked for {', '.join(dict.fromkeys(tried))}; "
        "check the name, or add its folder to data_folders"
    )
