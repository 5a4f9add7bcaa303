"""The columns of a measured table: signals and time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cluster_est.errors import DataError
from cluster_est.preflight.table_column import (
    TableColumn,
    guessed_noise,
)
from cluster_est.preflight.table_times import (
    LOOKED_AT,
    FoundTime,
    clock_column,
    find_tests,
    find_time,
    may_hold_numbers,
    own_clocks,
    refusal,
)
from cluster_est.problem.tables.cells import is_switch, is_text, trimmed_cells
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.gaps import long_steps
from cluster_est.problem.tables.jumps import count_jumps, recorded_at_changes
from cluster_est.problem.tables.long_tables import long_columns, wide
from cluster_est.problem.tables.measured_table import (
    Column,
    MeasuredTable,
    Reading,
    UndecidedError,
)
from cluster_est.problem.tables.sparse_inputs import is_sparse
from cluster_est.problem.tables.stand_ins import is_missing, stand_ins
from cluster_est.problem.tables.units import split_unit
from workers.messages import FloatArray


@dataclass(frozen=True)
class TableColumns:
    """The columns of a table.

    Attributes
    ----------
    path
        Path of the table's file.
    signals
        Columns of numbers except the time, with all rows.
    time
        The column with the time; None if no column has such a name.
    increasing
        Names of columns that increase from row to row, if there is no time.
    unusable
        Reasons why columns contain no numbers, by name.
    reading, found
        The user's options for reading the file, and keys for what was detected.
    notes
        Sentences about how it was read.
    split_by, tests
        The column that distinguishes tests in it, and their names; empty for a single test.
    refused
        Reasons for columns of numbers with a value that is not a number, by name.
    missing
        Numbers of which the user says that they mark missing measurements.
    files
        Paths of the files of one test, if there are several.
    refusal
        Why check and fit refuse its times; "" if they do not.
    """

    path: Path
    signals: tuple[TableColumn, ...]
    time: TableColumn | None
    increasing: tuple[str, ...]
    unusable: Mapping[str, str]
    reading: Reading = field(default_factory=Reading)
    found: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    split_by: str = ""
    tests: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    missing: tuple[float, ...] = ()
    files: tuple[Path, ...] = ()
    refusal: str = ""

    @property
    def named(self) -> dict[str, TableColumn]:
        """All columns of numbers by name, including the time."""
        every = self.signals if self.time is None else (self.time, *self.signals)
        return {column.name: column for column in every}


def read_columns(
    path: Path,
    time_column: str = "",
    reading: Reading | None = None,
    missing: tuple[float, ...] = (),
) -> TableColumns:
    """Read a table and classify its columns.

    Parameters
    ----------
    path
        Path of the table.
    time_column
        Name of the column with the time, if the table has it; otherwise it is found by name.
    reading
        The user's options for reading it.
    missing
        Numbers that mark missing measurements.

    Raises
    ------
    DataError
        If it cannot be read, or has no column of numbers.
    """
    table = read_table(path, "init", reading=reading)
    long = long_columns([*table.columns]) if table.reading.long is None else None
    if long is not None:
        table = replace(wide(table, *long), reading=replace(table.reading, long=long))
        table = replace(table, found={**table.found, "long": long})
    found = find_time(table, time_column)
    own = own_clocks(table)
    table = replace(table, clocks={**table.clocks, **own})
    if own and found is None:
        found = find_time(table)
    return columns_of(table, found, own, missing)


def columns_of(
    table: MeasuredTable,
    found: FoundTime | None,
    own: Mapping[str, str],
    missing: tuple[float, ...],
) -> TableColumns:
    """Classify the columns of a table with a known time.

    Parameters
    ----------
    table, found
        The table and its time, if it is known.
    own
        Names of time columns of signals with their own times.
    missing
        Numbers that mark missing measurements.

    Raises
    ------
    DataError
        If it has no column of numbers.
    """
    split_by = find_tests(table, found)
    tests = tuple(table.tests(split_by, "init")) if split_by else ()
    whole = table
    if tests:
        table = table.part(split_by, tests[0], "init")
        found = found if found is None else found.of(table)
    columns, others, refused = _columns(table, found, split_by, missing)
    clocks = {name: clock_column(table, name) for name in own}
    columns = [
        each
        if found is None or clocks.get(each.name, found.column).name == found.column.name
        else replace(each, clock=clocks[each.name])
        for each in columns
    ]
    if not columns and refused:
        raise DataError(next(iter(refused.values())))
    if not columns:
        raise DataError(
            f"init: {table.path} must have columns of numbers, but has none{_why_none(others)}; "
            "check the separator between columns, and that the first row has the columns' names"
        )
    rising = [] if found is not None else [c.name for c in columns if c.increases]
    wrong = "" if found is None else refusal(found, table, [c.name for c in columns])
    return TableColumns(
        Path(table.path),
        tuple(columns),
        None if found is None else found.column,
        tuple(rising),
        others,
        reading=whole.reading,
        found=whole.found,
        notes=(
            *whole.notes,
            *_note_on_clocks(own),
            *(_notes_on_times(found) if found is not None else ()),
            *(f"{why}; check and fit refuse the table until then" for why in (wrong,) if why),
        ),
        split_by=split_by,
        tests=tests,
        refused=refused,
        missing=missing,
        refusal=wrong,
    )


def _note_on_clocks(own: Mapping[str, str]) -> Iterator[str]:
    """Yield a note on signals with their own times."""
    if own:
        pairs = ", ".join(f"{clock!r} for {name!r}" for name, clock in own.items())
        yield f"its signals have their own times: {pairs}"


def _notes_on_times(found: FoundTime) -> Iterator[str]:
    """Yield notes on how times were read, and on missing rows."""
    if found.said:
        yield found.said
    gaps = long_steps(np.unique(found.seconds[np.isfinite(found.seconds)])).tolist()
    if gaps:
        first, last = gaps[0]
        more = f" (and {len(gaps) - 1} more gaps)" if len(gaps) > 1 else ""
        yield (
            f"no rows between {first:.10g} and {last:.10g} of {found.column.name!r}{more}; set "
            'gaps = "split" or "bridge" in the experiment to choose how the part after the gap is '
            "treated"
        )


def _columns(
    table: MeasuredTable, time: FoundTime | None, split_by: str, missing: Sequence[float]
) -> tuple[list[TableColumn], dict[str, str], dict[str, str]]:
    """Return the columns of numbers that can be signals, the others, and reasons for errors.

    Columns are read one at a time, so that a large file is not in memory twice.
    """
    refused: dict[str, str] = {}
    clocks = {*table.clocks.values(), *(() if time is None else time.names)}
    found: list[tuple[int, TableColumn]] = []
    counts: list[int] = []
    others = dict(table.unusable)
    for name in table.columns:
        if name in clocks or name == split_by:
            continue
        values = np.zeros(0)
        try:
            if name and may_hold_numbers(table.columns[name]):
                values = table.numbers(name, "init")
        except UndecidedError:
            raise
        except DataError as error:
            refused[name] = str(error)
        if not np.isfinite(values).any():
            others |= {name: _not_numbers(table.columns[name])} if name else {}
            continue
        times = None if time is None else time.times_of(table, name)
        rows = len(values) if times is None or len(times) != len(values) else -1
        plain, unit = split_unit(name)
        values = np.where(is_missing(values, missing), np.nan, values)
        codes = tuple(each.value for each in stand_ins(values))
        values = np.where(is_missing(values, codes), np.nan, values)
        clock = np.arange(float(len(values))) if times is None or rows >= 0 else times
        there = np.isfinite(values) & np.isfinite(clock)
        known = clock[there], values[there]
        column = TableColumn(
            name,
            plain,
            unit or table.units.get(name, ""),
            guessed_noise(values),
            count_jumps(*known) if time is None or rows < 0 else 0,
            increases=_increases(values),
            at_changes=time is not None and rows < 0 and recorded_at_changes(*known),
            stand_ins=codes,
            is_switch=is_switch(table.columns[name]),
        )
        found.append((rows, column))
        counts.append(int(there.sum()))
    found = _with_few(found, counts)
    if time is not None:
        return [column for rows, column in found if rows < 0], others, refused
    usual = Counter(rows for rows, _ in found).most_common(1)
    return [column for rows, column in found if usual and rows == usual[0][0]], others, refused


def _with_few(
    columns: Sequence[tuple[int, TableColumn]], counts: Sequence[int]
) -> list[tuple[int, TableColumn]]:
    """Mark columns with much fewer values than another; only these may be records of changes."""
    most = max(counts, default=0)
    return [
        (rows, replace(column, few=True))
        if is_sparse(count, most)
        else (rows, replace(column, at_changes=False))
        for (rows, column), count in zip(columns, counts, strict=True)
    ]


def _not_numbers(column: Column) -> str:
    """Return what a column contains instead of numbers."""
    if isinstance(column, np.ndarray) or not is_text(column):
        return "holds no numbers"
    there = trimmed_cells(column.slice(0, LOOKED_AT)).drop_null()
    return f"holds {there[0].as_py()!r}" if len(there) else "is empty"


def _why_none(others: Mapping[str, str]) -> str:
    """Return what is wrong with the first column that cannot be used."""
    return next((f" ({name!r} {why})" for name, why in others.items()), "")


def _increases(values: FloatArray) -> bool:
    return len(values) > 1 and bool(np.all(np.diff(values) > 0.0))
