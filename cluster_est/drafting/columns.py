"""The columns of a measured table: names, units, and the time among them."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_est.drafting.units import conversion
from cluster_est.errors import DataError
from cluster_est.problem.tables.files import MeasuredTable, read_table
from workers.messages import FloatArray

TIMES = ("time", "t", "times", "zeit", "seconds", "second", "sec", "timesec", "timestamp")
"""Names of a time column, folded."""

LEAST_NOISE = 1e-3
"""Of a signal's standard deviation."""
LEAST_SAMPLES = 10
"""Samples from which on noise can be guessed at all."""

_IN_BRACKETS = re.compile(r"(.*?)[\s_]*[\[(<]([^\[\](){}<>]*)[\])>]\s*")
_AFTER_SLASH = re.compile(r"(.*\S)\s+(?:/|in)\s+(\S+)\s*")


@dataclass(frozen=True)
class TableColumn:
    """One column of numbers.

    Attributes
    ----------
    name
        As it stands in the table.
    plain, unit
        "force" and "N" of "force [N]".
    noise
        A first guess of the standard deviation of its noise, in its unit; 0 if there is none.
    """

    name: str
    plain: str
    unit: str
    noise: float = 0.0

    @property
    def folded(self) -> str:
        return fold(self.plain)


@dataclass(frozen=True)
class TableColumns:
    """The columns of a table.

    Attributes
    ----------
    path
        The table's file.
    signals
        Columns of numbers besides the time, as many rows as it has.
    time
        The column with the time; None if none is called so.
    increasing
        Names of columns that increase from row to row, where there is no time.
    unusable
        Names of columns that hold no numbers.
    """

    path: Path
    signals: tuple[TableColumn, ...]
    time: TableColumn | None
    increasing: tuple[str, ...]
    unusable: tuple[str, ...]


def fold(name: str) -> str:
    """Return a name without case, blanks, underscores, brackets: "motorspeed" of "Motor_Speed"."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def read_columns(path: Path) -> TableColumns:
    """Read a table and sort its columns.

    Raises
    ------
    DataError
        If it cannot be read, or has no column of numbers.
    """
    table = read_table(path, "init")
    numbers, unusable = _numbers(table)
    if not numbers:
        raise DataError(
            f"init: {path} must have columns of numbers but has none; check what separates its "
            "columns, and that its first row holds their names"
        )
    columns = [TableColumn(name, *split_unit(name), _noise(v)) for name, v in numbers.items()]
    time = next((c for c in columns if _is_time(c)), None)
    rows = Counter(len(values) for values in numbers.values()).most_common(1)[0][0]
    if time is not None:
        rows = len(numbers[time.name])
    kept = [c for c in columns if c is not time and len(numbers[c.name]) == rows]
    rising = [] if time is not None else [c.name for c in kept if _increases(numbers[c.name])]
    return TableColumns(path, tuple(kept), time, tuple(rising), tuple(unusable))


def _numbers(table: MeasuredTable) -> tuple[dict[str, FloatArray], list[str]]:
    """Return the columns of numbers by name, and the names of the others."""
    found, others = {}, list(table.unusable)
    for name in table.columns:
        try:
            values = table.numbers(name, "init")
        except DataError:
            others.append(name)
            continue
        if name and np.isfinite(values).any():
            found[name] = values
        elif name:
            others.append(name)
    return found, others


def split_unit(name: str) -> tuple[str, str]:
    """Return "force" and "N" of "force [N]"; the unit is "" where there is none."""
    found = _IN_BRACKETS.fullmatch(name) or _AFTER_SLASH.fullmatch(name)
    if found is None or not found.group(1).strip():
        return name, ""
    return found.group(1).strip(), found.group(2).strip()


def _noise(values: FloatArray) -> float:
    """Estimate the standard deviation of a signal's noise from second differences.

    A smooth signal has hardly any. Their median is taken, so that a few jumps do not count, and at
    least a part of the signal's own deviation: sensors are no better.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < LEAST_SAMPLES:
        return 0.0
    spread = float(1.4826 * np.median(np.abs(np.diff(finite, 2))) / np.sqrt(6.0))
    return max(spread, LEAST_NOISE * float(np.std(finite)))


def _is_time(column: TableColumn) -> bool:
    if column.folded not in TIMES:
        return False
    return not column.unit or conversion(column.unit, "s") is not None


def _increases(values: FloatArray) -> bool:
    return len(values) > 1 and bool(np.all(np.diff(values) > 0.0))
