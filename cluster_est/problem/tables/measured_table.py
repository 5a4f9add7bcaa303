"""Measured tables: named columns as in the file, and their conversion to numbers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cluster_est.errors import DataError
from cluster_est.problem.tables.cells import (
    AmbiguousNumberError,
    as_numbers,
    first_text,
    is_numeric,
    is_text,
    text_numbers,
)
from workers.fmu.description import nearest
from workers.messages import FloatArray
from workers.messages.types import by_content

MOST_NAMED_COLUMNS = 30
"""Largest number of columns that a message names."""
Column: TypeAlias = "pa.ChunkedArray | FloatArray"


@dataclass(frozen=True)
class Reading:
    """The user's options for reading a file.

    Attributes
    ----------
    encoding
        Encoding of a text file. Empty: by its byte order mark, else UTF-8 or a guess with a note.
    skip_rows
        Number of lines of a text file before its header; None: determined from the file.
    decimal
        Decimal separator, "." or ","; the other sign then separates thousands. Empty: determined
        from the file.
    sheet
        The sheet of a workbook, or the experiment of an FMU; empty if there is only one.
    time_format
        Format of times as text, such as "%d/%m/%Y %H:%M:%S"; empty: determined from the file.
    time_zone
        Time zone of times without a zone, such as "Europe/Berlin"; empty: no daylight saving time.
    long
        (column of names, column of values) of a table with a row for each value; None for others.
    """

    encoding: str = ""
    skip_rows: int | None = None
    decimal: str = ""
    sheet: str = ""
    time_format: str = ""
    time_zone: str = ""
    long: tuple[str, str] | None = None


@by_content
@dataclass(frozen=True)
class MeasuredTable:
    """A measured file with its columns as in the file.

    Attributes
    ----------
    path
        Path of the file, or another name for messages.
    columns
        Arrow arrays or NumPy arrays by name.
    unusable
        For each unusable column, the reason.
    decimal
        Decimal separator of the file's texts, "." or ",". "" if it is unknown, and ";" if in
        addition points may be thousands separators.
    units
        Units of columns that the file gives outside of the column names.
    clocks
        For each column with own times in the file, the column with these times.
    notes
        Sentences on how the file was read.
    found
        Options of `Reading` that state what was determined or guessed.
    reading
        The user's options.
    lines
        Line numbers of all rows of the table, as in an editor; None if rows are counted from 1.
    rows
        The used rows of the columns; None for all.
    long_values, signals
        For a table with a row for each value: the column of the values, and the rows of each
        signal.
    files
        For each column of a test in several files, the table of its file and its name there.
    dated
        Whether the times of several files were counted from a date.
    parsed
        Numeric columns that were already parsed, with all rows.
    stamps
        Likewise columns with timestamps.
    """

    path: Path | str
    columns: dict[str, Column] = field(repr=False)
    unusable: dict[str, str] = field(default_factory=dict)
    decimal: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    found: Mapping[str, Any] = field(default_factory=dict)
    reading: Reading = field(default_factory=Reading)
    lines: LineNumbers | None = None
    rows: npt.NDArray[np.int64] | None = field(default=None, repr=False)
    long_values: str = ""
    signals: Mapping[str, npt.NDArray[np.int64]] = field(default_factory=dict, repr=False)
    files: Mapping[str, tuple[MeasuredTable, str]] = field(default_factory=dict, repr=False)
    dated: bool = False
    parsed: dict[str, FloatArray] = field(default_factory=dict, repr=False, compare=False)
    stamps: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def numbers(self, name: str, where: str) -> FloatArray:
        """Return a column as floats; NaN for missing measurements.

        Raises
        ------
        DataError
            If there is no such column, or a cell is not a number.
        """
        table, own = self.files.get(self.resolved(name), (self, name))
        if table is not self:
            return table.numbers(own, where)
        rows = self.rows_of(name)
        if rows is not None:
            return self.all_numbers(name, where)[rows]
        column = self.column(name, where)
        if isinstance(column, np.ndarray):
            return column
        return self._parsed(self.resolved(name), column, where)

    def all_numbers(self, name: str, where: str) -> FloatArray:
        """Return all rows of a column as floats; they are parsed once for all tests and signals."""
        column, name = self.column(name, where), self.resolved(name)
        if isinstance(column, np.ndarray):
            return column
        key = self.long_values if name in self.signals else name
        if key not in self.parsed:
            self.parsed[key] = self._parsed(key, column, where)
        return self.parsed[key]

    def rows_of(self, name: str) -> npt.NDArray[np.int64] | None:
        """Return the used rows of a column; None for all rows of the file."""
        own = self.signals.get(self.resolved(name))
        if own is None or self.rows is None:
            return self.rows if own is None else own
        return np.intersect1d(own, self.rows, assume_unique=True)

    def column(self, name: str, where: str) -> Column:
        """Return all rows of a column as in the file.

        Raises
        ------
        DataError
            If there is no such column, or several columns match a pattern.
        """
        name = self.resolved(name, where)
        if name in self.unusable:
            raise DataError(f"{where}: {self.path}, column {name!r}: {self.unusable[name]}")
        if name not in self.columns:
            raise DataError(f"{where}: {self.without(name)}")
        column = self.columns[name]
        if not isinstance(column, np.ndarray) and pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        return column

    def resolved(self, name: str, where: str = "") -> str:
        """Return the column that matches a pattern with *; return any other name unchanged."""
        if "*" not in name or name in self.columns or name in self.unusable:
            return name
        start, *middle, end = name.split("*")
        names = self.files or self.columns
        fitting = [each for each in names if _fits(each, start, middle, end)]
        if len(fitting) > 1 and where:
            listed = ", ".join(repr(each) for each in fitting[:MOST_NAMED_COLUMNS])
            raise DataError(
                f"{where}: {self.path}, column {name!r}: must match one column, but matches "
                f"{listed}; write more of the name"
            )
        return fitting[0] if len(fitting) == 1 else name

    def _parsed(self, name: str, column: pa.ChunkedArray, where: str) -> FloatArray:
        if is_text(column):
            try:
                return text_numbers(column, self.reading.decimal, self.decimal)
            except AmbiguousNumberError as error:
                raise UndecidedError(
                    f"{where}: {self.path}, column {name!r}, row {self.line(error.index)}: the "
                    f"separator in {error.cell!r} may be a decimal or a thousands separator; set "
                    'decimal = "." or decimal = ","'
                ) from None
            except pa.ArrowInvalid:
                self._refuse(name, column, where)
        if not is_numeric(column):
            raise DataError(
                f"{where}: {self.path}, column {name!r}: must hold numbers, but holds "
                f"{column.type}; convert it to numbers"
            )
        return as_numbers(column)

    def without(self, name: str) -> str:
        """Return an error message on a missing column, with the nearest name and all columns."""
        names = [*self.columns]
        found = nearest(name, names)
        fields = [each for each in names if each.endswith(f".{name}")]
        if len(fields) == 1:
            found = f"; did you mean {fields[0]!r}?"
        if not names and self.unusable:
            found = "; " + "; ".join(f"{n!r} {why}" for n, why in [*self.unusable.items()][:5])
        listed = ", ".join(repr(each) for each in names[:MOST_NAMED_COLUMNS])
        more = len(names) - MOST_NAMED_COLUMNS
        listed += f" and {more} more" if more > 0 else ""
        ending = f"{found} Its columns are {listed}" if found.endswith("?") else found
        return f"{self.path} has no column {name!r}{ending}"

    def row(self, index: int, column: str = "") -> int:
        """Return the line number of a value of a column, as in an editor."""
        table, own = self.files.get(self.resolved(column), (self, column))
        if table is not self:
            return table.row(index, own)
        rows = self.rows_of(column)
        return self.line(index if rows is None else int(rows[index]))

    def source(self, column: str) -> Path | str:
        """Return the path of the file that has a column."""
        return self.files.get(self.resolved(column), (self, ""))[0].path

    def line(self, index: int) -> int:
        """Return the line number of a row, counted over all rows of the file."""
        return index + 1 if self.lines is None else self.lines.number(index)

    def part(self, column: str, value: str, where: str) -> MeasuredTable:
        """Return the table with only the rows of one of several tests.

        Parameters
        ----------
        column, value
            The column that distinguishes the tests, and its value for this test.
        where
            Start of each message.

        Raises
        ------
        DataError
            If there is no such column or value.
        """
        groups = self.tests(column, where)
        if value not in groups:
            raise DataError(
                f"{where}.split_value: {self.path}, column {column!r}: has no value "
                f"{value!r}{nearest(value, [*groups])}"
            )
        return replace(self, rows=groups[value])

    def tests(self, column: str, where: str) -> dict[str, npt.NDArray[np.int64]]:
        """Return the rows of each value of a column, in the order of their first rows.

        Raises
        ------
        DataError
            If there is no such column.
        """
        cells = self.column(column, where)
        array = pa.chunked_array([pa.array(cells)]) if isinstance(cells, np.ndarray) else cells
        codes = array.combine_chunks().dictionary_encode()
        places = codes.indices.fill_null(-1).to_numpy(zero_copy_only=False).astype(np.int64)
        order = np.argsort(places, kind="stable")
        counts = np.bincount(places[places >= 0], minlength=len(codes.dictionary))
        parts = np.split(order[int(np.sum(places < 0)) :], np.cumsum(counts)[:-1])
        names = [_label(each) for each in codes.dictionary.to_pylist()]
        return {name: rows for name, rows in zip(names, parts, strict=True) if name}

    def _refuse(self, name: str, column: pa.ChunkedArray, where: str) -> NoReturn:
        index = first_text(column, self.reading.decimal, self.decimal)
        value = repr(column[index].as_py())
        raise DataError(
            f"{where}: {self.path}, column {name!r}, row {self.line(index)}: must be a number, but "
            f"is {value if len(value) < 60 else value[:57] + '...'}; correct it, or leave the cell "
            "empty if nothing was measured (on and off, true and false, ein and aus are read as 1 "
            "and 0, but other words are not)"
        )


class UndecidedError(DataError):
    """Raised if a column can be read in several ways, so that the user must choose one."""


class LineNumbers(ABC):
    """Line numbers of the rows of a text file, which are computed when a message needs them."""

    @abstractmethod
    def number(self, index: int) -> int:
        """Return the line number, counted from 1, of the row at an index."""


def _fits(name: str, start: str, middle: Sequence[str], end: str) -> bool:
    """Return whether a name contains the parts of a pattern in order."""
    if len(name) < len(start) + len(end) or not (name.startswith(start) and name.endswith(end)):
        return False
    inside, at = name[len(start) : len(name) - len(end)], 0
    for part in middle:
        found = inside.find(part, at)
        if found < 0:
            return False
        at = found + len(part)
    return True


def _label(value: object) -> str:
    """Return a cell as the name of a test; 3.0 gives "3"."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value).strip()


def repeated(count: int) -> str:
    """Return the reason why a column whose name is repeated cannot be used."""
    return f"must occur once, but {count} columns have that name; rename them"


def once(pairs: Sequence[tuple[str, Column]]) -> tuple[dict[str, Column], dict[str, str]]:
    """Return columns by name, without blanks around the names.

    Returns
    -------
    columns, unusable
        The columns with unique names, and the reasons why the others cannot be used.
    """
    named = [(name.strip(), column) for name, column in pairs]
    counts = Counter(name for name, _ in named)
    unusable = {name: repeated(count) for name, count in counts.items() if count > 1}
    return {name: column for name, column in named if name not in unusable}, unusable


def named_columns(path: Path | str, table: pa.Table) -> MeasuredTable:
    """Return an Arrow table as a measured table."""
    return MeasuredTable(path, *once(list(_columns(table))))


def _columns(table: pa.Table) -> Iterator[tuple[str, pa.ChunkedArray]]:
    for i, name in enumerate(table.column_names):
        yield name, table.column(i)
