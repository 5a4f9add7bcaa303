"""Experiments from tables in memory: of pandas, polars or pyarrow, or a dict of columns."""

from __future__ import annotations

import math
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


def table_of(given: Any, where: str) -> MeasuredTable:
    """A table in memory as a measured table.

    Parameters
    ----------
    given
        A DataFrame of pandas or polars, a table of pyarrow, a dict of columns, or a path.
    where
        Opens each message.

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
        return named_columns("the table", pa.table(given))
    raise DataError(
        f"{where}: must be a pandas, polars or pyarrow table, a dict of columns or a path, but is "
        f"{type(given).__name__!r}; convert it"
    )


def _index_name(given: Any) -> str | None:
    """The name of a frame's index, where that says more than the numbers of its rows."""
    index: Any = getattr(given, "index", None)
    if getattr(index, "name", None) is not None:  # of pandas
        return str(index.name)
    is_time = getattr(getattr(index, "dtype", None), "kind", "") in ("M", "m", "f")
    return INDEX if is_time else None


def _from_columns(pairs: Sequence[tuple[str, Any]]) -> MeasuredTable:
    """Columns of pandas or of a dict; one that Arrow cannot read is unusable, not an error yet."""
    counts = Counter(name for name, _ in pairs)
    columns: dict[str, Column] = {}
    unusable = {name: repeated(count) for name, count in counts.items() if count > 1}
    for name, column in pairs:
        if name in unusable:
            continue
        if hasattr(column, "reset_index"):  # Arrow may ask for its values by their places
            column = column.reset_index(drop=True)
        if isinstance(column, np.ndarray) and column.dtype.kind in "Mm":
            column = column.astype(f"{column.dtype.kind}8[ns]")  # not all units are Arrow's
        try:
            columns[name] = pa.chunked_array([pa.array(column, from_pandas=True)])
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            unusable[name] = f"must hold numbers, but cannot be read ({reason})"
    return MeasuredTable("the table", columns, unusable)


Columns = Mapping[str, str | Mapping[str, Any]] | Sequence[str]
"""Variables of the FMU, each with its column, or its column and more; or names that both have."""
INDEX = "index"
"""Name of the times that a frame of pandas has as its index without a name."""
OF_INPUTS = ("column", "interpolation", "time")
OBSERVED = ("free_scale", "free_offset", "detection_limit", "ordinal")
OF_OUTPUTS = ("column", "time", *OBSERVED)
"""What may be said of an input or an output, in place of its column alone."""


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

    Columns are checked as those of a file that a config names. Empty cells (NaN, None) mean that
    nothing was measured there.

    Parameters
    ----------
    table
        A DataFrame of pandas or polars, a table of pyarrow, a dict of columns, what `read_table`
        gave, or the path of a file.
    id
        Name of the experiment.
    outputs
        {FMU output: column}, a list of names that both have, or {FMU output: {"column": ...,
        "free_scale": True}}. Besides `free_scale` there are `time` (a column with times of its
        own), `free_offset`, `detection_limit` and
        `ordinal`, as in `Output`; `ordinal` may be a list of words too, the lowest first, if these
        stand in the column.
    time
        Column with the time: seconds, timestamps, or durations. Timestamps, and numbers of seconds
        since 1970, count from the first used row. "DATE + CLOCK" joins two columns. Of a frame of
        pandas, its index if this and `sample_time` are left out; "index" is one without a name.
    sample_time
        Seconds between rows, where there is no such column.
    inputs, signals
        {FMU input: column}, or {FMU input: {"column": ..., "interpolation": "hold", "time": ...}};
        `time` names a column with times of its own. Signals are
        measured too, but are no inputs of the model: effects may depend on them.
    sigma
        Standard deviation of the noise, of all outputs or by output.
    relative_sigma
        Likewise the part of each measured value that its noise has besides; only with sigma.
    columns
        {column: {"factor": ..., "offset": ..., "demean": ..., "late": ...}}: changes of unit, and
        seconds by which its times are late.
    rows
        (from, to): rows from (counted from 0) up to, not with, to.
    missing
        One or several numbers in the columns that mean that nothing was measured, such as -9999.
    left_out
        {FMU output: times in seconds of samples that do not count}, such as outliers.
    start, stop
        Simulated interval in seconds; by default as far as the data goes.
    values
        Known start values of this run by variable name.
    role
        "train", or "test" for an experiment that is only predicted.
    groups
        Labels by key, for parameters with ``per = "group:KEY"``.
    gaps
        "split" lets what is behind a gap in which inputs may have moved begin with initial states
        of its own, which a fit estimates; "bridge" draws inputs through.
    cost_function
        A function of a `SimulatedRun` (`times`, `simulated[NAME]`, `measured[NAME]`, `sigma[NAME]`,
        `values[NAME]`) that returns residuals, or one number with the cost "total", in place of
        those of the outputs. It runs on the workers, which are sent a copy.

    Raises
    ------
    DataError
        If a column is missing or holds something that is no measurement.
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
    reader = MeasuredColumns(_table(table, where), where, _rows(rows, where), changes, absent)
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


def _table(table: Any, where: str) -> MeasuredTable:
    return table_of(Path(table) if isinstance(table, str) else table, where)


def _named(given: Columns, where: str, known: tuple[str, ...]) -> dict[str, Mapping[str, Any]]:
    """The column of each variable, and what is said of it besides."""
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
    """A measured output, with what is said of how it was observed."""
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
    """The outputs without the samples that do not count."""
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
    """A number for each output, from one for all of them or from those of some."""
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
