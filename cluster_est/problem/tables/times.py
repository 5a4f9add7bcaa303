"""Reads the times of a table's rows in seconds: numbers, timestamps, and times since 1970.

Numbers are seconds, unless they are in the range of times since 1970 in seconds, milliseconds,
microseconds or nanoseconds. No run lasts for thirty years. Times since 1970 and timestamps count
from the first used row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from cluster_est.errors import DataError
from cluster_est.problem.tables.measured_table import MeasuredTable, UndecidedError
from cluster_est.problem.tables.time_stamps import (
    HOUR,
    StampError,
    Stamps,
    added,
    finished,
    read_stamps,
)
from cluster_est.toml import dotted
from workers.messages import FloatArray

JOINT: Final = " + "
"""Separator between the names of a column of dates and a column of times of day."""
FIRST_EPOCH, LAST_EPOCH = 946_684_800.0, 4_102_444_800.0
"""Seconds since 1970 at the beginning of 2000 and of 2100."""
EPOCH_UNITS: Final = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
FIRST_TICK, LAST_TICK = 1.25911584e17, 1.57469184e17
"""Windows ticks of 100 ns since 1601 at the beginning of 2000 and of 2100. The same numbers as
nanoseconds since 1970 are times in 1973 and 1974."""
DAYS: Final = ((36526.0, 73051.0), (730486.0, 767011.0))
"""Day numbers of Excel and of MATLAB at the beginning of 2000 and of 2100."""
Rows = npt.NDArray[np.int64] | None


@dataclass(frozen=True)
class TableTimes:
    """Times of rows.

    Attributes
    ----------
    seconds : (n,)
        Times in seconds; NaN for rows without a time.
    origin
        The time from which they count: nanoseconds for timestamps, or a number of the file. None
        for numbers that are used as in the file.
    said
        How the times were read; "" for numbers that are used as in the file.
    """

    seconds: FloatArray
    origin: int | float | None = None
    said: str = ""


def read_times(
    table: MeasuredTable,
    column: str,
    rows: Rows,
    where: str,
    *,
    factor: float | None = None,
    offset: float = 0.0,
    since: TableTimes | None = None,
) -> TableTimes:
    """Read the times of some rows.

    Parameters
    ----------
    table, column
        The column, or "DATE + CLOCK" for two columns.
    rows
        The used rows; None for all.
    where
        Start of each message.
    factor, offset
        The user's factor and offset for numbers. A factor of None means that none is given.
    since
        Other times with the same origin.

    Raises
    ------
    DataError
        If the column has no times, or can be read in several ways.
    """
    at = f"{where}: {table.path}, column {column!r}"
    stamps: Stamps | None = None
    try:
        if column not in table.stamps:  # all rows are read once for all tests
            table.stamps[column] = _stamps(table, column, where)
        stamps = table.stamps[column]
        if stamps is not None:
            stamps = finished(_used(stamps, rows), table.reading)
    except StampError as error:
        index = error.index
        if index is not None and stamps is not None and rows is not None:
            index = int(rows[index])
        row = "" if index is None else f", row {table.line(index)}"
        raise DataError(f"{at}{row}: {error}") from None
    if stamps is None:
        return _of_numbers(table, column, rows, where, (factor, offset), since)
    if factor not in (None, 1.0) or offset:
        raise DataError(
            f"{where}.columns: the time column {column!r} contains timestamps, so it must have "
            "neither factor nor offset; remove them"
        )
    ns, known = stamps.ns, stamps.known
    if not known.any():
        return TableTimes(np.full(len(ns), np.nan))
    origin = int(ns[np.argmax(known)]) if since is None else since.origin
    if stamps.kind == "elapsed":
        origin = 0
    if not isinstance(origin, int):
        raise DataError(f"{at}: must hold numbers, as the other times do, but holds timestamps")
    seconds = np.where(known, (ns - origin) / 1e9, np.nan)
    return TableTimes(seconds, origin, _said(column, stamps, origin))


def _used(stamps: Stamps, rows: Rows) -> Stamps:
    return stamps if rows is None else replace(stamps, ns=stamps.ns[rows], known=stamps.known[rows])


def _said(column: str, stamps: Stamps, origin: int) -> str:
    if stamps.kind == "elapsed":
        return f"its times, column {column!r}, are durations"
    how = f" ({stamps.said})" if stamps.said else ""
    first = np.datetime64(origin, "ns").astype("datetime64[ms]").astype(str).replace("T", " ")
    if stamps.kind == "clock":
        first = f"{origin // HOUR:02d}{first.partition(' ')[2][2:]}"
    zone = " UTC" if stamps.aware else ""
    return (
        f"its times, column {column!r}, are counted in seconds from the first row, "
        f"{first}{zone}{how}"
    )


def _stamps(table: MeasuredTable, column: str, where: str) -> Stamps | None:
    """Return the timestamps of a column or of two joined columns; None for numbers."""
    if JOINT in column and column not in table.columns:
        date, clock = (
            read_stamps(table.column(name, where), table.reading) for name in column.split(JOINT, 1)
        )
        if date is None or clock is None:
            raise StampError("must be a column of dates and a column of times of day, but are not")
        return added(date, clock)
    found = read_stamps(table.column(column, where), table.reading)
    if found is None and table.reading.time_format:
        raise StampError(
            "time_format: has no meaning for a column that contains no text; remove it"
        )
    return found


def _of_numbers(
    table: MeasuredTable,
    column: str,
    rows: Rows,
    where: str,
    scale: tuple[float | None, float],
    since: TableTimes | None,
) -> TableTimes:
    factor, offset = scale
    at = f"{where}: {table.path}, column {column!r}"
    values = table.numbers(column, where) if rows is None else None
    values = table.all_numbers(column, where)[rows] if values is None else values
    if since is not None and isinstance(since.origin, int):
        raise DataError(f"{at}: must hold timestamps, as the other times do, but holds numbers")
    if factor is None and _are_days(values):
        change = f"{dotted('columns', column)} = {{ factor = "
        raise UndecidedError(
            f"{at}: must be in seconds, but looks like days as Excel or MATLAB count them; write "
            f"{change}86400 }} if they are days, or {change}1.0 }} if they are seconds"
        )
    if factor is None and _are_ticks(values):
        origin = float(values[np.isfinite(values)][0]) if since is None else since.origin
        if isinstance(origin, float):
            said = f"its times, column {column!r}, are Windows times (units of 100 ns since 1601); "
            said += "they are counted in seconds from the first row"
            return TableTimes((values - origin) * 1e-7, origin, said)
    factor = 1.0 if factor is None else factor
    unit = _epoch_unit(values, factor)
    if not unit or offset:
        return TableTimes(values * factor + offset if (factor, offset) != (1.0, 0.0) else values)
    size = 1.0 / factor if factor != 1.0 else EPOCH_UNITS[unit]
    origin = float(values[np.isfinite(values)][0]) if since is None else since.origin
    if not isinstance(origin, float):
        raise DataError(
            f"{at}: must be counted from the same time as the other times, but is counted from 1970"
        )
    day = np.datetime64(int(origin / size * 1e3), "ms").astype(str).replace("T", " ")
    said = (
        f"its times, column {column!r}, are {unit} since 1970; they are counted in seconds from "
        f"the first row, {day} UTC"
    )
    return TableTimes((values - origin) / size, origin, said)


def _are_days(values: FloatArray) -> bool:
    """Return whether numbers are dates in days.

    Seconds may also be in this range, but their mean step is then a whole number of microseconds.
    """
    known = values[np.isfinite(values)]
    if len(known) < 2 or not any(low <= known[0] and known[-1] < high for low, high in DAYS):
        return False
    step = float(np.mean(np.diff(known)))
    rounded = abs(step * 1e6 - round(step * 1e6)) > 0.02
    return 0.0 < step < 0.5 and rounded


def _are_ticks(values: FloatArray) -> bool:
    """Return whether numbers are Windows ticks."""
    known = values[np.isfinite(values)]
    return bool(len(known) and known.min() >= FIRST_TICK and known.max() < LAST_TICK)


def _epoch_unit(values: FloatArray, factor: float) -> str:
    """Return the unit of times since 1970; "" for other numbers."""
    known = values[np.isfinite(values)]
    if not len(known):
        return ""
    low, high = float(known.min()), float(known.max())
    if factor != 1.0:
        return "times" if low * factor >= FIRST_EPOCH and high * factor < LAST_EPOCH else ""
    for unit, size in EPOCH_UNITS.items():
        if size * FIRST_EPOCH <= low and high < size * LAST_EPOCH:
            return unit
    return ""
