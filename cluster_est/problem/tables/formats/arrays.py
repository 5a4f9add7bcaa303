"""Converts the arrays of a file to columns, and assigns their times.

A vector is a column, and a matrix has a column for each of its signals. Groups of channels and
fields of structures may have their own times at different rates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.problem.tables.measured_table import Column, MeasuredTable
from workers.messages import FloatArray

TIME_NAMES = ("time", "t", "times", "zeit", "timestamp", "timestamps")
"""Usual names, in lower case, of the times of all columns in the same group."""
MOST_MATRIX_SIGNALS = 1000
"""Largest number of signals in a matrix, which has fewer signals than samples."""


def columns_of(name: str, values: Any) -> Iterator[tuple[str, Column | str]]:
    """Yield the columns of an array with their names, or the reason why it has none.

    Parameters
    ----------
    name
        Name of the array.
    values
        An array of numbers, times or texts, a structured array, or anything else.
    """
    array = np.atleast_1d(values) if isinstance(values, np.ndarray | np.generic) else None
    if array is not None and array.dtype.names:
        for field in array.dtype.names:
            yield from columns_of(f"{name}.{field}", array[field])
        return
    shape = " x ".join(str(n) for n in np.shape(values))
    what = f"must be a vector of numbers, but is {shape or 'a'} "
    what += f"{values.dtype}" if isinstance(values, np.ndarray) else type(values).__name__
    if array is None:
        yield name, what
    elif array.ndim == 1 and array.dtype.kind in "fiub":
        yield name, array.astype(np.float64)
    elif array.ndim == 1 and array.dtype.kind in "MmOSU":
        yield name, _others(array) or what
    elif array.ndim == 2 and array.dtype.kind in "fiub" and min(array.shape) <= MOST_MATRIX_SIGNALS:
        signals = array if len(array) < len(array.T) else array.T
        own = {f"{name}[{i}]": each for i, each in enumerate(signals)}
        yield from ((key, each.astype(np.float64)) for key, each in own.items())
        yield name, f"{what}; name one of its signals, {name}[0] to {[*own][-1]}"
    else:
        yield name, what


def clocks_in(columns: Mapping[str, Column], separator: str) -> dict[str, str]:
    """Return the time column of each column that has one in its structure or group.

    Parameters
    ----------
    columns
        Columns by name.
    separator
        Separator between the parts of a name.
    """
    found: dict[str, str] = {}
    groups: dict[str, str] = {}
    for name in columns:
        group, point, last = name.rpartition(separator)
        if point and last.casefold() in TIME_NAMES:
            groups.setdefault(group, name)
    for name, column in columns.items():
        parts = name.split(separator)
        for depth in range(len(parts) - 1, 0, -1):
            clock = groups.get(separator.join(parts[:depth]))
            if clock is not None and clock != name and len(columns[clock]) == len(column):
                found[name] = clock
                break
    return found


def _others(array: np.ndarray[Any, Any]) -> pa.ChunkedArray | None:
    """Return times or texts as an Arrow column; None for anything else."""
    try:
        if array.dtype.kind == "S":
            array = np.char.decode(array, "utf-8", "replace")
        if array.dtype.kind == "O":
            texts = [
                each.decode("utf-8", "replace") if isinstance(each, bytes) else each
                for each in array
            ]
            return pa.chunked_array([pa.array(texts)])
        if array.dtype.kind in "Mm":
            array = array.astype(f"{array.dtype.kind}8[ns]")
        return pa.chunked_array([pa.array(array)])
    except (pa.ArrowException, UnicodeError, ValueError):
        return None


TIME_NAME = "time"
"""Name of the time column if all channels share it; otherwise GROUP/time."""


@dataclass
class Clocks:
    """The times of groups of channels, collected while a file is read."""

    times: dict[str, FloatArray] = field(default_factory=dict)
    groups: dict[str, str] = field(default_factory=dict)

    def add(self, column: str, group: object, times: FloatArray) -> None:
        """Add a column with the times of its group."""
        self.groups[column] = str(group)
        self.times.setdefault(str(group), times)

    def table(
        self,
        path: Path,
        columns: dict[str, Column],
        unusable: dict[str, str],
        units: dict[str, str],
    ) -> MeasuredTable:
        """Return the table with one time column for each different set of times."""
        names: dict[str, str] = {}
        different: dict[str, FloatArray] = {}
        for group, times in self.times.items():
            same = (name for name, each in different.items() if np.array_equal(each, times))
            name = next(same, f"{group}/{TIME_NAME}")
            different[name] = times
            names[group] = name
        if len(different) == 1 and TIME_NAME not in columns:
            names = dict.fromkeys(names, TIME_NAME)
            different = {TIME_NAME: next(iter(different.values()))}
        notes: tuple[str, ...] = ()
        if len(different) > 1:
            rates = (
                f"its channels have {len(different)} different time channels, and each channel is "
                "read with "
            )
            notes = (f"{rates}its own: {', '.join([*different][:6])}",)
        own: dict[str, Column] = {**different, **columns}
        units = dict.fromkeys(different, "s") | units
        clocks = {column: names[group] for column, group in self.groups.items()}
        return MeasuredTable(path, own, unusable, units=units, clocks=clocks, notes=notes)
