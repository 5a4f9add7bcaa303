"""Excel workbooks (xlsx), with openpyxl: the table of a sheet, which may have rows above it."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats.header import Header, find_header, refuse_several
from cluster_est.problem.tables.formats.table_format import TableFormat, library
from cluster_est.problem.tables.measured_table import (
    Column,
    LineNumbers,
    MeasuredTable,
    Reading,
    once,
)
from cluster_est.toml import inline

LOOKED_AT = 300
"""Number of rows in which the header is searched for."""


class Workbook(TableFormat):
    """Workbooks with a table in a sheet."""

    name: ClassVar[str] = "xlsx"
    endings: ClassVar[tuple[str, ...]] = (".xlsx", ".xlsm")
    keys: ClassVar[tuple[str, ...]] = ("sheet", "skip_rows", "decimal")

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        openpyxl = library("openpyxl", "openpyxl", path.suffix)
        try:
            opened = openpyxl.load_workbook(path, read_only=True, data_only=True)
        except OSError:
            raise
        except Exception as error:  # openpyxl raises various exceptions
            raise DataError(
                f"must be a workbook, but cannot be read as one ({type(error).__name__}: {error}); "
                "save it again"
            ) from error
        try:
            sheet, rows, header = _chosen(opened, reading)
        finally:
            opened.close()
        found: dict[str, Any] = {}
        notes = []
        if len(opened.sheetnames) > 1:
            notes.append(f"sheet {inline(sheet)} is read")
            found |= {} if reading.sheet else {"sheet": sheet}
        if header.header and reading.skip_rows is None:
            notes.append(f"its header is in row {header.header + 1} (skip_rows = {header.header})")
            found["skip_rows"] = header.header
        return replace(_table(path, rows, header), notes=tuple(notes), found=found)


def _table(path: Path, rows: Sequence[Sequence[Any]], header: Header) -> MeasuredTable:
    """Return the rows below a header as a table; the decimal separator of texts is unknown."""
    numbers = [i for i in range(header.first, len(rows)) if rows[i]]
    data = [rows[i] for i in numbers]
    columns: list[tuple[str, Column]] = [
        (name, _column([row[i] if i < len(row) else None for row in data]))
        for i, name in enumerate(header.names)
        if name
    ]
    units = {header.names[i]: unit for i, unit in header.units.items()}
    lines = _Rows(tuple(i + 1 for i in numbers))
    return MeasuredTable(path, *once(columns), ";", units, lines=lines)


@dataclass(frozen=True)
class _Rows(LineNumbers):
    """Numbers of the nonempty rows of a sheet."""

    numbers: tuple[int, ...]

    def number(self, index: int) -> int:
        return self.numbers[index]


def _chosen(opened: Any, reading: Reading) -> tuple[str, list[Sequence[Any]], Header]:
    """Return the name of the sheet with the table, its rows, and its header."""
    names = [sheet.title for sheet in opened.worksheets]
    if reading.sheet:
        if reading.sheet not in names:
            listed = ", ".join(map(repr, names))
            raise DataError(
                f"must have the sheet {reading.sheet!r}, but has {listed}; choose one of these"
            )
        names = [reading.sheet]
    found = []
    for name in names:
        rows = [_cut(row) for row in opened[name].iter_rows(values_only=True)]
        header = _header(rows, reading.skip_rows)
        if header is not None:
            found.append((name, rows, header))
    if not found:
        raise DataError(
            "must have a sheet with a header and rows of numbers, but has none; check the file, or "
            "name the sheet with the key sheet"
        )
    if len(found) > 1:
        listed = ", ".join(repr(name) for name, _, _ in found)
        raise DataError(
            f"has several sheets with tables: {listed}; choose one, as in sheet = "
            f"{inline(found[0][0])}"
        )
    return found[0]


def _cut(row: Sequence[Any]) -> Sequence[Any]:
    """Return a row without empty cells at its end."""
    end = len(row)
    while end and row[end - 1] is None:
        end -= 1
    return row[:end]


def _header(rows: list[Sequence[Any]], skip_rows: int | None) -> Header | None:
    start = skip_rows or 0
    head = rows[: start + LOOKED_AT]
    width = max(map(len, head), default=0)
    texts = [
        [_text(cell) for cell in row] + [""] * (width - len(row)) if row and i >= start else None
        for i, row in enumerate(head)
    ]
    found = find_header(texts, start)
    if found is not None and skip_rows is None:
        refuse_several(found)
    return found


def _text(cell: Any) -> str:
    if isinstance(cell, datetime.datetime | datetime.date | datetime.time):
        return cell.isoformat()
    return "" if cell is None else str(cell)


def _column(cells: list[Any]) -> Column:
    """Return a column as numbers, times or text, according to the types of its cells."""
    there = [cell for cell in cells if cell is not None]
    if there and all(isinstance(cell, int | float) for cell in there):
        return np.array([np.nan if cell is None else float(cell) for cell in cells], np.float64)
    if any(isinstance(cell, str | bool) for cell in there):
        cells = [None if cell is None else _text(cell) for cell in cells]
    try:
        return pa.chunked_array([pa.array(cells)])
    except (pa.ArrowException, OverflowError):
        texts = [None if cell is None else _text(cell) for cell in cells]
        return pa.chunked_array([pa.array(texts, pa.string())])
