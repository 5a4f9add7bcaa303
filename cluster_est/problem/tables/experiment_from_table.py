"""Makes experiments from tables in memory: pandas, polars, pyarrow, or a dict of columns."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow as pa

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.grades import with_grades
from cluster_est.problem.tables.measured import (
    Clock,
    ColumnChange,
    MeasuredColumns,
    interval,
    missing_time,
    relative_without_sigma,
    sigma_without_output,
    without_samples,
)
from cluster_est.problem.tables.measured_table import (
    Column,
    MeasuredTable,
    named_columns,
    repeated,
)
from cluster_est.problem.tables.several_files import clock_notes, join_files, timed_files
from workers.fmu.description import nearest
from workers.messages import (
    Experiment,
    FloatArray,
    GapRule,
    Input,
    Interpolation,
    Output,
    Role,
    Value,
)
from workers.messages.checks import (
    as_tuple,
    check_choice,
    check_flag,
    check_kind,
    check_name,
    check_number,
    check_once,
    is_number,
    shown,
)

IN_MEMORY = "the table"
"""Name of a table that is no file, in messages."""


def table_of(given: Any, where: str) -> MeasuredTable:
    """Return a table in memory as a measured table.

    Parameters
    ----------
    given
        A DataFrame of pandas or polars, a table of pyarrow, a dict of columns, or a path.
    where
        Start of each message.

    Raises
    ------
    DataError
        If it is none of these.
    """
    if isinstance(given, MeasuredTable):
        return given
    if isinstance(given, Path):
        return read_table(given, where)
    if hasattr(given, "items"):
        pairs = [(str(name), column) for name, column in given.items()]
        index: Any = getattr(given, "index", None)
        if (name := _index_name(given)) is not None:
            pairs.insert(0, (name, index.to_series()))
        return _from_columns(pairs)
    if hasattr(given, "__arrow_c_stream__") or isinstance(given, pa.RecordBatch):
        return named_columns(IN_MEMORY, pa.table(given))
    raise DataError(
        f"{where}: must be a pandas, polars or pyarrow table, a dict of columns or a path, but is "
        f"{type(given).__name__!r}; convert it"
    )


def _index_name(given: Any) -> str | None:
    """Return the name of a DataFrame's index; None for row numbers without a name."""
    index: Any = getattr(given, "index", None)
    if getattr(index, "name", None) is not None:  # a pandas index with a name
        return str(index.name)
    is_time = getattr(getattr(index, "dtype", None), "kind", "") in ("M", "m", "f")
    return INDEX if is_time else None


def _from_columns(pairs: Sequence[tuple[str, Any]]) -> MeasuredTable:
    """Return a table from columns; a column that Arrow cannot read is only marked as unusable."""
    counts = Counter(name for name, _ in pairs)
    columns: dict[str, Column] = {}
    unusable = {name: repeated(count) for name, count in counts.items() if count > 1}
    for name, column in pairs:
        if name in unusable:
            continue
        if hasattr(column, "reset_index"):  # Arrow may access values by position
            column = column.reset_index(drop=True)
        if isinstance(column, np.ndarray) and column.dtype.kind in "Mm":
            column = column.astype(f"{column.dtype.kind}8[ns]")  # Arrow lacks some units
        try:
            columns[name] = pa.chunked_array([pa.array(column, from_pandas=True)])
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            unusable[name] = f"must hold numbers, but cannot be read ({reason})"
    return MeasuredTable(IN_MEMORY, columns, unusable)


Columns = Mapping[str, str | Mapping[str, Any]] | Sequence[str]
"""Variables of the FMU with their columns (and options), or names of both variable and column."""
INDEX = "index"
"""Name of the time column for an unnamed index of a pandas DataFrame."""
OF_INPUTS = ("column", "interpolation", "time")
OBSERVED = ("free_scale", "free_offset", "detection_limit", "ordinal")
OF_OUTPUTS = ("column", "time", *OBSERVED)
"""Keys that may be given for an output; `OF_INPUTS` are those of an input or a signal."""


def experiment_from_table(
    table: Any,
    *,
    id: str,
    outputs: Columns,
    time: str | None = None,
    sample_time: float | None = None,
    inputs: Columns = (),
    signals: Columns = (),
    sigma: float | Mapping[str, float] = 1.0,
    relative_sigma: float | Mapping[str, float] = 0.0,
    columns: Mapping[str, Mapping[str, float | bool]] | None = None,
    rows: tuple[int, int] | None = None,
    missing: float | Sequence[float] = (),
    left_out: Mapping[str, Sequence[float]] | None = None,
    start: float | None = None,
    stop: float | None = None,
    values: Mapping[str, Value] | None = None,
    role: Role = "train",
    groups: Mapping[str, str] | None = None,
    gaps: GapRule = "split",
    cost_function: Callable[[Any], Any] | None = None,
) -> Experiment:
    """Make an experiment from a measured table.

    ::

        run = ce.Experiment.from_table(
            frame, id="step", time="t", inputs={"F": "force"}, outputs={"y": "position"}, sigma=0.01
        )

    Columns are checked like the columns of a file in a config. Empty cells (NaN, None) are missing
    measurements.

    Parameters
    ----------
    table
        A DataFrame of pandas or polars, a table of pyarrow, a dict of columns, a result of
        `read_table`, or the path of a file. A list of these: the files of one test, each with its
        own times in the column `time`. A column whose name is in several files gets the part of the
        file's name that differs: "speed.value"; without files, "1.value" for the first table.
    id
        Name of the experiment.
    outputs
        {FMU output: column}, a list of names of both output and column, or {FMU output: {"column":
        ..., "free_scale": True}}. Further keys are `time` (a column with own times), `free_offset`,
        `detection_limit` and `ordinal`, as in `Output`. `ordinal` may also be a list of the words
        in the column, the lowest first.
    time
        Column with the time: seconds, timestamps, or durations. Timestamps, and numbers of seconds
        since 1970, count from the first used row. "DATE + CLOCK" joins two columns. If `time` and
        `sample_time` are left out, the index of a pandas DataFrame is used. "index" is an index
        without a name.
    sample_time
        Seconds between rows, if there is no time column.
    inputs, signals
        {FMU input: column}, or {FMU input: {"column": ..., "interpolation": "hold", "time": ...}};
        `time` is a column with own times. Signals are measured, but they are not inputs of the
        model; effects may depend on them.
    sigma
        Standard deviation of the noise, for all outputs or by output.
    relative_sigma
        Additional noise as a fraction of each measured value, likewise; only with sigma.
    columns
        {column: {"factor": ..., "offset": ..., "demean": ..., "late": ...}}: changes of units, and
        the delay of the column's times in seconds.
    rows
        (from, to): the used rows, counted from 0, without row `to`.
    missing
        One or more numbers in the columns that mark missing measurements, such as -9999.
    left_out
        {FMU output: times in seconds of samples to leave out}, such as outliers.
    start, stop
        Simulated interval in seconds; by default the interval of the data.
    values
        Known start values of this run by variable name.
    role
        "train", or "test" for an experiment that is only predicted.
    groups
        Labels by key, for parameters with ``per = "group:KEY"``.
    gaps
        Treatment of gaps in which inputs may have changed. "split": the part after the gap has its
        own initial states, which a fit estimates. "bridge": inputs are interpolated.
    cost_function
        A function of a `SimulatedRun` (`times`, `simulated[NAME]`, `measured[NAME]`, `sigma[NAME]`,
        `values[NAME]`). It returns residuals, or one number with the cost "total", instead of the
        outputs' residuals. It runs in the workers, which receive a copy.

    Raises
    ------
    DataError
        If a column is missing or contains anything but measurements.
    """
    check_name(id, "experiment.id", DataError)
    where = f"experiment {id!r}"
    wanted = {
        key: _named(given, f"{where}.{key}", OF_OUTPUTS if key == "outputs" else OF_INPUTS)
        for key, given in (("outputs", outputs), ("inputs", inputs), ("signals", signals))
    }
    if not wanted["outputs"]:
        raise DataError(f"{where}.outputs is missing; add it (FMU output = column)")
    sigmas = _of_outputs(sigma, 1.0, wanted["outputs"], f"{where}.sigma")
    parts = _of_outputs(relative_sigma, 0.0, wanted["outputs"], f"{where}.relative_sigma")
    for name, part in parts.items():
        if part > 0.0 and sigmas[name] == 1.0:
            raise DataError(relative_without_sigma(where, name))
    if time is None and sample_time is None:
        time = _index_name(table)
    _check_times(time, sample_time, start, stop, where)
    changes, absent = _changes(columns, where), _missing(missing, where)
    chosen = _rows(rows, where)
    if isinstance(table, list | tuple) and len(table) > 1:
        if time is None or chosen is not None:
            raise DataError(
                f"{where}: several tables of one test need time, and no rows, but time is {time!r} "
                f"and rows is {chosen}; name the time column, and leave rows out"
            )
        whole, changes = _joined(table, time, changes, where)
    else:
        whole = _table(table[0] if isinstance(table, list | tuple) and table else table, where)
    reader = MeasuredColumns(whole, where, chosen, changes, absent)
    counted = next(iter(wanted["outputs"].values()))["column"]
    times = reader.times(time, sample_time, counted)
    measured = [
        _output(reader, times, name, given, (sigmas[name], parts[name]), time)
        for name, given in wanted["outputs"].items()
    ]
    measured = _without_left_out(measured, left_out or {}, f"{where}.left_out")
    if start is None:
        driven = [each["column"] for each in wanted["inputs"].values()]
        others = [each["column"] for k in ("outputs", "signals") for each in wanted[k].values()]
        start = reader.empty_until(times, driven, others)
    start, stop = interval(start, stop, times, measured, where)
    driving = {
        key: _driving(reader, times, wanted[key], key, time) for key in ("inputs", "signals")
    }
    return Experiment(
        id=id,
        start=start,
        stop=stop,
        inputs=driving["inputs"],
        outputs=tuple(_within(output, start, stop) for output in measured),
        values={} if values is None else values,  # type: ignore[arg-type]
        role=role,
        groups={} if groups is None else groups,  # type: ignore[arg-type]
        signals=driving["signals"],
        gaps=gaps,
        cost_function=cost_function,  # type: ignore[arg-type]
    )


def _joined(
    tables: Sequence[Any], time: str, changes: dict[str, ColumnChange], where: str
) -> tuple[MeasuredTable, dict[str, ColumnChange]]:
    """Join the tables of one test, and warn of differences between their clocks.

    The changes of the time column are applied to each table, so they are removed.
    """
    read = [_table(each, where) for each in tables]
    named = [
        replace(each, path=f"table {number}") if each.path == IN_MEMORY else each
        for number, each in enumerate(read, 1)
    ]
    change = changes.get(time, ColumnChange())
    files = timed_files(named, time, where, (change.factor, change.offset))
    whole = join_files(files, time)
    for said in clock_notes(files):
        warnings.warn(f"{where}: {said}", stacklevel=3)
    done = {time, *whole.clocks.values()}
    kept = {name: each for name, each in changes.items() if name not in done}
    return whole, dict.fromkeys(done, ColumnChange()) | kept


def _table(table: Any, where: str) -> MeasuredTable:
    return table_of(Path(table) if isinstance(table, str) else table, where)


def _named(given: Columns, where: str, known: tuple[str, ...]) -> dict[str, Mapping[str, Any]]:
    """Return the column and the options of each variable."""
    if not isinstance(given, Mapping):
        names = as_tuple(given, str, where, DataError)
        check_once(names, where, DataError)
        return {name: {"column": name} for name in names}
    found: dict[str, Mapping[str, Any]] = {}
    for name, each in given.items():
        check_name(name, f"{where}: a variable", DataError)
        entry = {"column": each} if isinstance(each, str) else each
        if not isinstance(entry, Mapping) or "column" not in entry:
            raise DataError(
                f"{where}.{name}: must be the name of a column or {{{', '.join(known)}}}, but is "
                f"{shown(each)}"
            )
        for key in entry:
            if key not in known:
                raise DataError(f"{where}.{name}: unknown key {key}{nearest(str(key), known)}")
        check_name(entry["column"], f"{where}.{name}.column", DataError)
        how = entry.get("interpolation", "linear")
        check_choice(how, get_args(Interpolation), f"{where}.{name}.interpolation", DataError)
        found[name] = entry
    return found


def _output(
    reader: MeasuredColumns,
    times: FloatArray,
    name: str,
    given: Mapping[str, Any],
    sigmas: tuple[float, float],
    time: str | None,
) -> Output:
    """Return a measured output with its options."""
    observed = {key: given[key] for key in OBSERVED if key in given}
    words = observed.get("ordinal")
    if isinstance(words, Sequence) and not isinstance(words, str):
        words = as_tuple(words, str, f"{reader.where}.outputs.{name}.ordinal", DataError)
        reader = with_grades(reader, name, given["column"], words)
        observed["ordinal"] = True
    clock = Clock(time, given.get("time", ""))
    return replace(reader.output(times, name, given["column"], *sigmas, clock), **observed)


def _without_left_out(
    measured: Sequence[Output], left_out: Mapping[str, Sequence[float]], where: str
) -> list[Output]:
    """Return the outputs without the samples to leave out."""
    names = [output.variable for output in measured]
    times: dict[str, tuple[float, ...]] = {}
    for name, given in left_out.items():
        check_name(name, f"{where}: an output", DataError)
        if name not in names:
            raise DataError(sigma_without_output(where, name, names))
        for i, time in enumerate(given):
            check_number(time, f"{where}.{name}[{i}]", DataError)
        times[name] = tuple(given)
    return [
        without_samples(each, times.get(each.variable, ()), f"{where}.{each.variable}")
        for each in measured
    ]


def _of_outputs(
    number: float | Mapping[str, float], default: float, outputs: Mapping[str, Any], where: str
) -> dict[str, float]:
    """Return a number for each output, from one number for all or from numbers by output."""
    given = number if isinstance(number, Mapping) else dict.fromkeys(outputs, number)
    for name, value in given.items():
        check_name(name, f"{where}: an output", DataError)
        if name not in outputs:
            raise DataError(sigma_without_output(where, name, outputs))
        above = 0.0 if default > 0.0 else -math.inf
        check_number(value, f"{where}.{name}", DataError, above=above, least=0.0)
    return {name: float(given.get(name, default)) for name in outputs}


def _changes(
    columns: Mapping[str, Mapping[str, float | bool]] | None, where: str
) -> dict[str, ColumnChange]:
    known = [each.name for each in fields(ColumnChange)]
    given = {} if columns is None else columns
    advice = "; write {column: {factor, offset, demean, late}}"
    check_kind(given, Mapping, f"{where}.columns", DataError, advice)
    found = {}
    for name, change in given.items():
        check_name(name, f"{where}.columns: a column", DataError)
        at = f"{where}.columns.{name}"
        check_kind(change, Mapping, at, DataError, "; write {factor, offset, demean, late}")
        for key, value in change.items():
            if key not in known:
                raise DataError(f"{at}: unknown key {key}{nearest(str(key), known)}")
            if key == "demean":
                check_flag(value, f"{at}.demean", DataError)
            else:
                check_number(value, f"{at}.{key}", DataError)
        found[name] = replace(ColumnChange(), **change)  # type: ignore[arg-type]
    return found


def _rows(rows: tuple[int, int] | None, where: str) -> tuple[int, int] | None:
    if rows is None:
        return None
    check_kind(rows, Sequence, f"{where}.rows", DataError, "; write (from, to)")
    for i, value in enumerate(rows):
        check_number(value, f"{where}.rows[{i}]", DataError, least=0, whole=True)
    if len(rows) != 2 or not rows[0] < rows[1]:
        raise DataError(
            f"{where}.rows: must be [from, to] with from below to, but is {list(rows)}; swap them, "
            "or leave rows out to use all rows"
        )
    return int(rows[0]), int(rows[1])


def _missing(missing: float | Sequence[float], where: str) -> tuple[float, ...]:
    given: Any = [missing] if is_number(missing) else missing
    check_kind(given, Sequence, f"{where}.missing", DataError, "; write [-9999]")
    for i, value in enumerate(given):
        check_number(value, f"{where}.missing[{i}]", DataError)
    return tuple(float(value) for value in given)


def _check_times(
    time: str | None,
    sample_time: float | None,
    start: float | None,
    stop: float | None,
    where: str,
) -> None:
    problem = missing_time(where, time, sample_time)
    if problem:
        raise DataError(problem)
    if time is not None:
        check_name(time, f"{where}.time", DataError)
    if sample_time is not None:
        check_number(sample_time, f"{where}.sample_time", DataError, above=0.0)
    for key, value in (("start", start), ("stop", stop)):
        if value is not None:
            check_number(value, f"{where}.{key}", DataError)


def _driving(
    reader: MeasuredColumns,
    times: FloatArray,
    wanted: Mapping[str, Mapping[str, Any]],
    key: str,
    time: str | None,
) -> tuple[Input, ...]:
    found = []
    for name, given in wanted.items():
        how, clock = given.get("interpolation", "linear"), Clock(time, given.get("time", ""))
        found.append(reader.driving(times, name, given["column"], how, key, clock))
    return tuple(found)


def _within(output: Output, start: float, stop: float) -> Output:
    kept = (output.times >= start) & (output.times <= stop)
    return replace(output, times=output.times[kept], values=output.values[kept])
