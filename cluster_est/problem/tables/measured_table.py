"""A measured table: named columns, each as it is in its file, and how they become numbers."""

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
"""Columns that a message names."""
Column: TypeAlias = "pa.ChunkedArray | FloatArray"


@dataclass(frozen=True)
class Reading:
    """What a user says of how a file is to be read, where it does not tell.

    Attributes
    ----------
    encoding
        Of a text file; empty: its mark, or UTF-8, or a guess that is said.
    skip_rows
        Lines of a text file before its header; None: found.
    decimal
        The sign before decimals, "." or ","; the other one then separates thousands. Empty: found.
    sheet
        The sheet of a workbook, or the experiment of an FMU; empty: its only one.
    time_format
        Of times as text, such as "%d/%m/%Y %H:%M:%S"; empty: found.
    time_zone
        Of times without one, such as "Europe/Berlin"; empty: clocks are not put forward.
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
    """A measured file, its columns still as they are in the file.

    Attributes
    ----------
    path
        The file that it came from, or a name for it, for messages.
    columns
        Arrow arrays or NumPy arrays by name.
    unusable
        Why a column that the file has cannot be used, by name.
    decimal
        The sign before decimals in its texts, "." or ","; "" where they do not tell, and ";" where
        they do not and points too may separate thousands.
    units
        Of columns that the file says in another place than in their names.
    clocks
        The column with the times of another one, where the file says so.
    notes
        What was found out about the file, a sentence each.
    found
        Keys of `Reading` that would say what was found, or guessed.
    reading
        What the user said of it.
    lines
        Rows of the file, from 1 and as an editor shows them, of all rows of the table; None where
        they are counted through.
    rows
        The rows of the columns that it has; None for all.
    long_values, signals
        Of a table with a row for each value: the column of the values, and the rows of each signal.
    parsed
        Columns of numbers that were parsed before, of all rows.
    stamps
        Likewise those of timestamps.
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
    parsed: dict[str, FloatArray] = field(default_factory=dict, repr=False, compare=False)
    stamps: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def numbers(self, name: str, where: str) -> FloatArray:
        """A column as floats, NaN where nothing was measured.

        Raises
        ------
        DataError
            If there is no such column, or if something in it is not a number.
        """
        rows = self.rows_of(name)
        if rows is not None:
            return self.all_numbers(name, where)[rows]
        column = self.column(name, where)
        if isinstance(column, np.ndarray):
            return column
        return self._parsed(self.resolved(name), column, where)

    def all_numbers(self, name: str, where: str) -> FloatArray:
        """A column as floats, of all rows of the file, parsed once for all tests and signals."""
        column, name = self.column(name, where), self.resolved(name)
        if isinstance(column, np.ndarray):
            return column
        key = self.long_values if name in self.signals else name
        if key not in self.parsed:
            self.parsed[key] = self._parsed(key, column, where)
        return self.parsed[key]

    def rows_of(self, name: str) -> npt.NDArray[np.int64] | None:
        """The rows of the file in which a column counts; None for all."""
        own = self.signals.get(self.resolved(name))
        if own is None or self.rows is None:
            return self.rows if own is None else own
        return np.intersect1d(own, self.rows, assume_unique=True)

    def column(self, name: str, where: str) -> Column:
        """A column as it is in the file, of all rows.

        Raises
        ------
        DataError
            If there is no such column, or several that fit a pattern.
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
        """The column that a pattern with * means; any other name is returned as it is."""
        if "*" not in name or name in self.columns or name in self.unusable:
            return name
        start, *middle, end = name.split("*")
        fitting = [each for each in self.columns if _fits(each, start, middle, end)]
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
        """The sentence on a column that the table does not have: the nearest one, and all."""
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
        """The row of the file, as an editor shows it, that a value of a column is from."""
        rows = self.rows_of(column)
        return self.line(index if rows is None else int(rows[index]))

    def line(self, index: int) -> int:
        """The same of all rows of the file."""
        return index + 1 if self.lines is None else self.lines.number(index)

    def part(self, column: str, value: str, where: str) -> MeasuredTable:
        """The rows of one test of several.

        Parameters
        ----------
        column, value
            The column that tells them apart, and its value.
        where
            Opens each message.

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
        """The rows of each value of a column, in the order in which they begin.

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
            "empty if nothing was measured"
        )


class UndecidedError(DataError):
    """A column may be read in several ways, and the user has to say in which."""


class LineNumbers(ABC):
    """Says which lines of a text file its rows are, when a message asks for one."""

    @abstractmethod
    def number(self, index: int) -> int:
        """The line, from 1, of the row at an index."""


def _fits(name: str, start: str, middle: Sequence[str], end: str) -> bool:
    """Return whether a name has the parts of a pattern in their order."""
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
    """Return a cell that names a test: 3 for 3.0, too."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value).strip()


def repeated(count: int) -> str:
    """The reason why a column that is there several times cannot be used."""
    return f"must occur once, but {count} columns have that name; rename them"


def once(pairs: Sequence[tuple[str, Column]]) -> tuple[dict[str, Column], dict[str, str]]:
    """Columns by name, without the blanks that some programs put around names.

    Returns
    -------
    columns, unusable
        The columns that have a name of their own; why the others cannot be used.
    """
    named = [(name.strip(), column) for name, column in pairs]
    counts = Counter(name for name, _ in named)
    unusable = {name: repeated(count) for name, count in counts.items() if count > 1}
    return {name: column for name, column in named if name not in unusable}, unusable


def named_columns(path: Path | str, table: pa.Table) -> MeasuredTable:
    """A table of Arrow as a measured table."""
    return MeasuredTable(path, *once(list(_columns(table))))


def _columns(table: pa.Table) -> Iterator[tuple[str, pa.ChunkedArray]]:
    for i, name in enumerate(table.column_names):
        yield name, table.column(i)
