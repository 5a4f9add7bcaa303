"""The columns of a measured table: names, units, and the time among them."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import MeasuredTable, read_table
from cluster_est.problem.tables.jumps import count_jumps
from cluster_est.problem.tables.units import WORDS, conversion, is_known
from workers.messages import FloatArray

TIMES = ("time", "t", "times", "zeit", "seconds", "second", "sec", "timesec", "timestamp")
"""Names of a time column, folded."""

LEAST_NOISE = 1e-3
"""Of a signal's standard deviation."""
LEAST_SAMPLES = 10
"""Samples from which on noise can be guessed at all."""

_IN_BRACKETS = re.compile(r"(.*?)[\s_]*[\[(<]([^\[\](){}<>]*)[\])>]\s*")
_AFTER_SLASH = re.compile(r"(.*\S)\s+(?:/|in)\s+(\S+)\s*")


MOST_PARTS = 3
"""Parts of a name that may be a unit: "rad_per_s"."""


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
    jumps
        Times that it jumps, if it keeps its value in between.
    """

    name: str
    plain: str
    unit: str
    noise: float = 0.0
    jumps: int = 0

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

    @property
    def named(self) -> dict[str, TableColumn]:
        """All columns of numbers by name, the time among them."""
        every = self.signals if self.time is None else (self.time, *self.signals)
        return {column.name: column for column in every}


def fold(name: str) -> str:
    """Return a name without case, blanks, underscores, brackets: "motorspeed" of "Motor_Speed"."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def read_columns(path: Path, time_column: str = "") -> TableColumns:
    """Read a table and sort its columns.

    Parameters
    ----------
    path
        Of the table.
    time_column
        Name of the column with the time, if it has one of that name; else the name must tell.

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
    time = _time(columns, time_column)
    rows = Counter(len(values) for values in numbers.values()).most_common(1)[0][0]
    if time is not None:
        rows = len(numbers[time.name])
    times = np.arange(float(rows)) if time is None else numbers[time.name]
    kept = [
        replace(c, jumps=count_jumps(times, numbers[c.name]))
        for c in columns
        if (time is None or c.name != time.name) and len(numbers[c.name]) == rows
    ]
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


def split_suffix(name: str, wanted: str) -> tuple[str, str] | None:
    """Return "speed" and "rpm" of "speed_rpm"; None if the end of a name is no unit.

    Parameters
    ----------
    name
        Of a column.
    wanted
        The unit of its variable. The end of the name must be convertible to it: "x_m" may be
        measured in metres, "u_m" of a voltage is not. Where it is "", only units of two letters and
        more count, and not "min".
    """
    parts = name.split("_")
    for count in range(min(MOST_PARTS, len(parts) - 1), 0, -1):
        plain, tail = "_".join(parts[:-count]), parts[-count:]
        unit = "/".join(part for part in tail if part != "per")
        unit = WORDS.get(unit, unit)
        if wanted:
            fits = conversion(unit, wanted) is not None
        else:
            fits = is_known(unit) and len(unit) > 1 and unit != "min"
        if fits and plain.strip("_"):
            return plain.strip("_"), unit
    return None


def with_suffix(column: TableColumn, wanted: str) -> TableColumn:
    """Return a column with the unit at the end of its name, if it has no other."""
    found = None if column.unit else split_suffix(column.name, wanted)
    return column if found is None else replace(column, plain=found[0], unit=found[1])


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


def _time(columns: list[TableColumn], given: str) -> TableColumn | None:
    """Return the column with the time, its unit split off."""
    for column in columns:
        if column.name == given:
            return with_suffix(column, "s")
    if any(_is_time(column) for column in columns):
        return next(column for column in columns if _is_time(column))
    ended = [with_suffix(column, "s") for column in columns]
    return next((c for c in ended if _is_time(c) and c.plain != "T"), None)


def _is_time(column: TableColumn) -> bool:
    if column.folded not in TIMES:
        return False
    return not column.unit or conversion(column.unit, "s") is not None


def _increases(values: FloatArray) -> bool:
    return len(values) > 1 and bool(np.all(np.diff(values) > 0.0))
