"""The times of a measured table, and the tests in it, found by names and by contents."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pyarrow as pa

from cluster_est.errors import DataError
from cluster_est.preflight.table_column import TableColumn, fold, with_suffix
from cluster_est.problem.tables.cells import MISSING, is_text, looks_like_a_number, without_groups
from cluster_est.problem.tables.measured_table import Column, MeasuredTable, UndecidedError
from cluster_est.problem.tables.time_stamps import Stamps, read_stamps
from cluster_est.problem.tables.times import JOINT, read_times
from cluster_est.problem.tables.units import conversion, split_unit
from workers.messages import FloatArray, IntArray
from workers.messages.signals import check_times

TIME_COLUMN_NAMES = (
    "time", "t", "times", "zeit", "seconds", "second", "sec", "timesec", "timestamp", "timestamps",
    "elapsedtime", "elapsed", "testtime", "zeitstempel", "xvalue", "relativetime", "trel",
    "millis", "micros", "epoch", "epochtime", "epochms", "unixtime", "unixtimestamp", "posixtime",
    "ts",
)  # fmt: skip
"""Names of a time column, folded."""
UNITS_OF_NAMES = {"millis": "ms", "micros": "us"}
"""Units that names of time columns imply."""
STAMP_COLUMN_NAMES = (
    *TIME_COLUMN_NAMES, "datetime", "date", "datum", "datumzeit", "datumuhrzeit", "uhrzeit",
    "datetimeutc", "index",
)  # fmt: skip
"""Names of a column with timestamps, folded."""
TEST_COLUMN_NAMES = (
    "run", "runid", "test", "testid", "experiment", "experimentid", "trial", "cycle", "versuch",
    "messung", "simulationconditionid", "condition",
)  # fmt: skip
"""Names of a column that distinguishes tests, folded."""
MOST_TESTS = 10_000
LOOKED_AT = 1000
"""Number of cells of a text column in which numbers are looked for."""
DAYS_OR_SECONDS = "days or seconds"
"""Placeholder for the unit of a time that must be filled in."""


@dataclass(frozen=True)
class FoundTime:
    """The time of a table.

    Attributes
    ----------
    column
        The column with the time; if it consists of two columns, both names.
    names
        Names of its columns.
    seconds : (n,)
        Seconds of all rows.
    said
        How timestamps were read; "" for numbers.
    """

    column: TableColumn
    names: tuple[str, ...]
    seconds: FloatArray = field(repr=False)
    said: str = ""

    def of(self, table: MeasuredTable) -> FoundTime:
        """Return the time of a part of the table."""
        found = read_times(table, self.column.name, table.rows, "init")
        return replace(self, seconds=found.seconds)

    def times_of(self, table: MeasuredTable, name: str) -> FloatArray:
        """Return the times of a column, which may have its own clock."""
        clock = table.clocks.get(name)
        if clock is not None and clock != self.column.name:
            return read_times(table, clock, table.rows_of(name), "init").seconds
        if name in table.signals:
            return read_times(table, self.column.name, table.rows_of(name), "init").seconds
        return self.seconds


def find_time(table: MeasuredTable, given: str = "") -> FoundTime | None:
    """Find the time of a table; None if no column has such a name, or is the only one with times.

    Parameters
    ----------
    table
        The table with all tests.
    given
        Name of its column, if given by the user.

    Raises
    ------
    DataError
        If there are ambiguous times.
    """
    names = [given] if given and (given in table.columns or JOINT in given) else [*_by_name(table)]
    if not names:
        names = [*_by_content(table)]
    if not names:
        return None
    name = names[0]
    column = with_suffix(_column(table, name), "s")
    if not _is_number(table, name):
        column = replace(column, unit="")
    factor = conversion(column.unit, "s") if column.unit else None
    size = None if factor is None else factor.factor
    try:
        found = read_times(table, name, None, "init", factor=size)
    except UndecidedError:
        column, size = replace(column, unit=DAYS_OR_SECONDS), 1.0
        found = read_times(table, name, None, "init", factor=size)
    return FoundTime(column, tuple(name.split(JOINT)), found.seconds, found.said)


def own_clocks(table: MeasuredTable) -> dict[str, str]:
    """Return the time column of each signal that has its own, by names such as "t_speed".

    The names must show this for at least two signals, and the times must increase. The column with
    most times comes first.
    """
    split = {name: _column(table, name) for name in table.columns if name}
    folded = {column.folded: name for name, column in split.items()}
    pairs = {
        name: clock
        for name, column in split.items()
        for before, after in (("t", ""), ("time", ""), ("", "time"), ("", "t"))
        if (clock := folded.get(f"{before}{column.folded}{after}", name)) != name
        and (not split[clock].unit or conversion(split[clock].unit, "s") is not None)
        and _holds_numbers(table, clock)
    }
    times = {clock: table.numbers(clock, "init") for clock in pairs.values()}
    times = {clock: seconds[np.isfinite(seconds)] for clock, seconds in times.items()}
    pairs = {name: c for name, c in pairs.items() if np.all(np.diff(times[c]) > 0.0)}
    if table.clocks or len(pairs) < 2 or len(set(pairs.values())) < len(pairs):
        return {}
    return dict(sorted(pairs.items(), key=lambda pair: -len(times[pair[1]])))


def clock_column(table: MeasuredTable, name: str) -> TableColumn:
    """Return the column with the own times of a signal, with its unit."""
    return with_suffix(_column(table, table.clocks[name]), "s")


def _is_number(table: MeasuredTable, name: str) -> bool:
    column = table.columns.get(name)
    return isinstance(column, np.ndarray) or (column is not None and _stamps(table, name) is None)


def _by_name(table: MeasuredTable) -> Iterator[str]:
    """Yield the columns of numbers with names of a time, the most certain first."""
    if table.clocks:
        counts: dict[str, int] = {}
        for clock in table.clocks.values():
            counts[clock] = counts.get(clock, 0) + 1
        yield max(counts, key=lambda name: counts[name])
    split = {name: _column(table, name) for name in table.columns if name}
    numeric = [name for name in split if _holds_numbers(table, name)]
    yield from (name for name in numeric if _is_time(split[name]))
    ended = {name: with_suffix(split[name], "s") for name in numeric}
    yield from (n for n, column in ended.items() if _is_time(column) and column.plain != "T")


def _column(table: MeasuredTable, name: str) -> TableColumn:
    plain, unit = split_unit(name)
    unit = unit or table.units.get(name, "") or UNITS_OF_NAMES.get(fold(plain), "")
    return TableColumn(name, plain, unit)


def _is_time(column: TableColumn) -> bool:
    if column.folded not in TIME_COLUMN_NAMES:
        return False
    return not column.unit or conversion(column.unit, "s") is not None


def _holds_numbers(table: MeasuredTable, name: str) -> bool:
    if not may_hold_numbers(table.columns[name]):
        return False
    try:
        return bool(np.isfinite(table.numbers(name, "init")).any())
    except UndecidedError:
        raise
    except DataError:
        return False


def may_hold_numbers(column: Column) -> bool:
    """Return False for times, and for text without a number in its first cells.

    So a long text need not be read completely.
    """
    if isinstance(column, np.ndarray):
        return True
    if not is_text(column):
        return not _is_temporal(column.type)
    head = [str(cell).strip() for cell in column.slice(0, LOOKED_AT).to_pylist() if cell]
    there = [cell for cell in head if cell not in MISSING]
    return not there or any(looks_like_a_number(without_groups(cell)) for cell in there)


def _is_temporal(kind: pa.DataType) -> bool:
    return bool(pa.types.is_temporal(kind))


def _by_content(table: MeasuredTable) -> Iterator[str]:
    """Yield the column with timestamps, or the two with dates and times of day, if unique."""
    found = {name: each for name in table.columns if (each := _stamps(table, name)) is not None}
    dates = [name for name, each in found.items() if each.kind == "date"]
    clocks = [name for name, each in found.items() if each.kind == "clock"]
    whole = [name for name, each in found.items() if each.kind in ("instant", "elapsed")]
    called = [n for n in whole if fold(split_unit(n)[0]) in STAMP_COLUMN_NAMES]
    if called or len(whole) == 1:
        yield (called or whole)[0]
    elif len(clocks) == 1:
        yield f"{dates[0]}{JOINT}{clocks[0]}" if len(dates) == 1 else clocks[0]
    elif len(dates) == 1 and not clocks:
        yield dates[0]


def _stamps(table: MeasuredTable, name: str) -> Stamps | None:
    """Return the timestamps of a column; None if it has none."""
    column = table.columns[name]
    if isinstance(column, np.ndarray) or not (is_text(column) or _is_temporal(column.type)):
        return None
    called = fold(split_unit(name)[0]) in STAMP_COLUMN_NAMES
    try:
        if name not in table.stamps:
            table.stamps[name] = read_stamps(column, table.reading)
    except ValueError:
        if called:  # it is the time, so its error must be reported
            read_times(table, name, None, "init")
        return None
    found: Stamps | None = table.stamps[name]
    return found


def refusal(found: FoundTime, table: MeasuredTable, names: Sequence[str]) -> str:
    """Return why check and fit refuse the times of a table's columns; "" if they do not."""
    own = [name for name in names if name in table.signals or name in table.clocks]
    for name in own if table.signals else ("", *own):
        seconds = found.times_of(table, name) if name else found.seconds
        known = np.flatnonzero(np.isfinite(seconds)) if name else np.arange(len(seconds))
        places = partial(_place, table, name, known)
        where = f"column {table.clocks.get(name, found.column.name)!r}"
        try:
            check_times(seconds[known], where, places, of_rows=not name)
        except DataError as error:
            return str(error)
    return ""


def _place(table: MeasuredTable, name: str, rows: IntArray, i: int) -> str:
    return f"row {table.row(int(rows[i]), name)}"


def find_tests(table: MeasuredTable, time: FoundTime | None) -> str:
    """Return the column that distinguishes tests; "" if the table is one test.

    It is found by its name, or because the time restarts exactly where its value changes. In each
    test, the time must increase.
    """
    if time is None or table.clocks:
        return ""
    seconds = time.seconds
    anew = np.flatnonzero(np.diff(seconds) <= 0.0)
    names = [name for name in table.columns if name not in time.names and name not in table.signals]
    called = [name for name in names if fold(name) in TEST_COLUMN_NAMES]
    if not table.signals and not len(anew):
        return ""
    for name in [*called, *(n for n in names if n not in called)]:
        try:
            groups = table.tests(name, "init")
        except (DataError, pa.ArrowException):
            continue
        if not 1 < len(groups) <= min(MOST_TESTS, len(seconds) // 2):
            continue
        if table.signals:
            if name in called:
                return name
        elif all(np.all(np.diff(seconds[rows]) > 0.0) for rows in groups.values()):
            return name
    return ""
