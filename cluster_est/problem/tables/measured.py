"""Reads columns of a measured table as signals of an experiment.

The used rows are selected, scaled and checked. Config files and `Experiment.from_table` both use
this module, which also finds unused columns.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from cluster_est.errors import DataError
from cluster_est.problem.tables.gaps import STEPS_OF_GAP
from cluster_est.problem.tables.measured_table import MeasuredTable
from cluster_est.problem.tables.stand_ins import is_missing
from cluster_est.problem.tables.times import JOINT, TableTimes, read_times
from cluster_est.problem.tables.units import column_unit
from workers.fmu.description import nearest
from workers.messages import FloatArray, Input, Interpolation, Output
from workers.messages.checks import told_apart
from workers.messages.signals import check_length, check_times, refuse_value

SAME_TIME = 1e-9
"""Difference between two times, over the time or the record's length, that counts as rounding."""


@dataclass(frozen=True)
class ColumnChange:
    """A change of unit and times: column * factor + offset; `demean` first removes the mean.

    `late` is the delay of a column in seconds: it was measured earlier than its times by `late`.
    """

    factor: float = 1.0
    offset: float = 0.0
    demean: bool = False
    late: float = 0.0


@dataclass(frozen=True)
class Clock:
    """The source of the times of a column.

    Attributes
    ----------
    time
        The column with the times of the rows; None if the rows have a fixed period.
    own
        A time column that the user names for this column; "" for the times of the file or rows.
    """

    time: str | None = None
    own: str = ""


OF_ROWS = Clock()


@dataclass(frozen=True)
class MeasuredColumns:
    """Columns of one experiment's table.

    Attributes
    ----------
    table
        The measured file, or a table in memory.
    where
        Start of each message, such as "experiment 'e1'".
    rows
        (from, to): the used rows, counted from 0, without row `to`; None for all.
    changes
        Changes of columns, by name.
    missing
        Numbers in the file that mark missing measurements; in the time column they are times.
    """

    table: MeasuredTable
    where: str
    rows: tuple[int, int] | None = None
    changes: Mapping[str, ColumnChange] = field(default_factory=dict)
    missing: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in self.changes:
            if self.table.resolved(name, self.where) not in self.table.columns:
                raise DataError(f"{self.where}.columns: {self.table.without(name)}")

    def times(self, column: str | None, sample_time: float | None, counted: str) -> FloatArray:
        """Return the time of each used row.

        Parameters
        ----------
        column
            The time column; None if rows are `sample_time` seconds apart.
        sample_time
            Seconds between rows.
        counted
            A column that gives the number of rows, if there is no time column.
        """
        path = self.table.path
        if column is not None:
            times = self.clock(column).seconds
            if self.table.signals:  # the table has a row for each value, so times are repeated
                times = np.unique(times[np.isfinite(times)])
            source = f"{path}, column {column!r}"
        else:
            with np.errstate(over="ignore"):
                rows = np.arange(len(self.column(counted)), dtype=np.float64)
                times = rows * (sample_time or 1.0)
            source = f"sample_time = {sample_time}"
        if len(times) < 2:
            raise DataError(
                f"{self.where}: must use at least two rows of {path}, but uses {len(times)}; "
                + (
                    "check rows"
                    if self.rows
                    else "check that there are measurements below the header"
                )
            )
        where = f"{self.where}: {source}"
        check_times(times, where, lambda i: f"row {self._row(i)}", of_rows=not self.table.signals)
        return times

    def clock(self, column: str) -> TableTimes:
        """Return the times in a column, in seconds of its file or since the first used row.

        Raises
        ------
        DataError
            If the column contains no times, or if there are several ways to read it.
        """
        if (self._change(column) or ColumnChange()).demean:
            return TableTimes(self.column(column))
        rows = self.table.rows_of(column)
        if self.rows is not None:
            whole = self.table.column(column.split(JOINT)[0], self.where) if rows is None else rows
            rows = self._used(np.arange(len(whole)) if rows is None else rows)
        factor, offset = self._scale(column)
        return read_times(self.table, column, rows, self.where, factor=factor, offset=offset)

    def _scale(self, column: str) -> tuple[float | None, float]:
        """Return the factor and offset of a time column; the factor is None if none is given."""
        change = self._change(column)
        return (None, 0.0) if change is None else (change.factor, change.offset)

    def _change(self, name: str) -> ColumnChange | None:
        """Return the change of a column; its key may be a pattern."""
        own = self.table.resolved(name)
        return next((c for n, c in self.changes.items() if self.table.resolved(n) == own), None)

    def unit(self, name: str) -> str:
        """Return the unit of a column; "" if it is not known, or if the numbers are converted."""
        change = self._change(name) or ColumnChange()
        converted = (change.factor, change.offset) != (1.0, 0.0)
        return "" if converted else column_unit(self.table.resolved(name), self.table.units)

    def _late(self, name: str) -> float:
        """Return the delay of a column in seconds."""
        return (self._change(name) or ColumnChange()).late

    def _used(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the used rows."""
        if self.rows is None:
            return rows
        first, last = self.rows
        if last > len(rows):
            raise DataError(
                f"{self.where}.rows: must lie within the {len(rows)} rows of {self.table.path}, "
                f"but is [{first}, {last}]; lower its end"
            )
        return rows[first:last]

    def own_times(self, name: str, clock: Clock, times: FloatArray) -> FloatArray:
        """Return the times of one column: those of its own clock, or those of the rows.

        Parameters
        ----------
        name
            Name of the column.
        clock
            The source of its times.
        times
            Times of the rows.
        """
        table, resolved = self.table, self.table.resolved(name)
        own = clock.own or table.clocks.get(resolved)
        selected = resolved in table.signals
        if clock.time is None or (own in (None, table.resolved(clock.time)) and not selected):
            return times
        if self.rows is not None:
            raise DataError(
                f"{self.where}.rows: cannot be used if a column has its own times, as {name!r} "
                "has; use start and stop instead"
            )
        first, rows = self.clock(clock.time), table.rows_of(resolved)
        source = clock.time if selected else str(own)
        factor, offset = self._scale(source)
        found = read_times(
            table, source, rows, self.where, factor=factor, offset=offset, since=first
        ).seconds
        known = np.flatnonzero(np.isfinite(found)) if clock.own else np.arange(len(found))
        where = f"{self.where}: {table.source(name)}, times of column {name!r}"
        check_times(found[known], where, lambda i: f"row {table.row(int(known[i]), resolved)}")
        return found

    def driving(
        self,
        times: FloatArray,
        variable: str,
        column: str,
        interpolation: Interpolation,
        key: str,
        clock: Clock = OF_ROWS,
    ) -> Input:
        """Return a signal that drives the model, without the rows without a measurement."""
        times = self.own_times(column, clock, times)
        values = self._values(times, column, f"{key}.{variable}")
        known = self._known(times, values, column)
        return Input(variable, times[known] - self._late(column), values[known], interpolation)

    def output(
        self,
        times: FloatArray,
        variable: str,
        column: str,
        sigma: float,
        relative_sigma: float,
        clock: Clock = OF_ROWS,
    ) -> Output:
        """Return a signal that the model should follow, without the rows without a measurement."""
        times = self.own_times(column, clock, times)
        values = self._values(times, column, f"outputs.{variable}")
        measured = self._known(times, values, column)
        times = times[measured] - self._late(column)
        return Output(variable, times, values[measured], sigma, relative_sigma)

    def empty_until(self, times: FloatArray, inputs: Sequence[str], others: Sequence[str]) -> float:
        """Return the time of the first row with a value, if the rows before it form a gap.

        Otherwise return the time of the first row; without inputs, this row may have no value.
        """
        known = np.zeros(len(times), dtype=bool)
        for name in (*inputs, *others) if inputs else ():
            try:
                values = self.column(name)
            except DataError:  # an ordinal output may have words
                return float(times[0])
            if len(values) != len(times) or np.isfinite(values[0]):  # or it has its own times
                return float(times[0])
            known |= np.isfinite(values)
        first = float(times[np.argmax(known)])
        gap = STEPS_OF_GAP * float(np.median(np.diff(times)))
        return first if first - times[0] > gap else float(times[0])

    def points(self, columns: Collection[str]) -> FloatArray:
        """Return the points of a curve without incomplete points: (n, d).

        Raises
        ------
        DataError
            If there are fewer than two points.
        """
        found = [self.column(name) for name in columns]
        lengths = {len(values) for values in found}
        if len(lengths) > 1:
            raise DataError(
                f"{self.where}.curve: all columns must have the same number of rows, but have "
                f"{' and '.join(str(n) for n in sorted(lengths))}; choose other columns"
            )
        points = np.column_stack(found)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) < 2:
            raise DataError(
                f"{self.where}.curve: must have at least two points, but has {len(points)} in "
                f"{self.table.path}; check the columns and rows"
            )
        return np.ascontiguousarray(points)

    def column(self, name: str) -> FloatArray:
        """Return the used rows of a column in its new unit; NaN for missing measurements."""
        values = self._used(self.table.numbers(name, self.where))
        if self.missing:
            values = np.where(is_missing(values, self.missing), np.nan, values)
        change = self._change(name)
        if change is None:
            return values
        known = np.isfinite(values)
        with np.errstate(over="ignore", invalid="ignore"):
            mean = float(np.mean(values[known])) if change.demean and known.any() else 0.0
            return (values - mean) * change.factor + change.offset

    def _values(self, times: FloatArray, name: str, key: str) -> FloatArray:
        values = self.column(name)
        column = f"column {name!r} of {self.table.source(name)}"
        check_length(values, times, f"{self.where}.{key}: {column}")
        if np.isnan(values).all():
            raise DataError(
                f"{self.where}.{key}: {column} must hold at least one number, but is empty in the "
                f"used rows; choose another column or remove {key}"
            )
        infinite = np.flatnonzero(np.isinf(values))
        if len(infinite):
            i = int(infinite[0])
            where = f"{self.where}: {self.table.source(name)}, column {name!r}"
            where += f", row {self._row(i, name)}"
            raise refuse_value(float(values[i]), where, "leave it empty")
        return values

    def _known(self, times: FloatArray, values: FloatArray, name: str) -> npt.NDArray[np.bool_]:
        """Return a mask of the measured values; a column with its own times may end earlier."""
        known = np.isfinite(values)
        without = np.flatnonzero(known & ~np.isfinite(times))
        if len(without):
            raise DataError(
                f"{self.where}: {self.table.source(name)}, column {name!r}, row "
                f"{self.table.row(int(without[0]), name)}: must have a time for each value, but "
                "has none; correct that row"
            )
        return known

    def _row(self, used: int, column: str = "") -> int:
        """Return the row number in the file of a used row."""
        return self.table.row((self.rows[0] if self.rows else 0) + used, column)


def interval(
    start: float | None,
    stop: float | None,
    times: FloatArray,
    outputs: Sequence[Output],
    where: str,
) -> tuple[float, float]:
    """Return the simulated interval: the given one, or that of the data.

    Parameters
    ----------
    start, stop
        The given values; None if they are not given.
    times
        Times of the rows, or of all measurements.
    outputs
        The last sample of all outputs ends the interval.
    where
        Start of each message.

    Raises
    ------
    DataError
        If the start is not before the stop.
    """
    if start is None:
        start = float(times[0])
    if stop is None:
        stop = float(max((o.times[-1] for o in outputs if len(o.times)), default=times[-1]))
    if not start < stop:
        begin, end = told_apart(start, stop)
        raise DataError(
            f"{where}.start: must be before stop, which is {end} s, but is {begin} s; change "
            "one of them, or leave both out to take them from the data"
        )
    return start, stop


def missing_time(where: str, time: str | None, sample_time: float | None) -> str:
    """Return an error message if times are given twice or not at all; "" otherwise."""
    given = [each for each in (time, sample_time) if each is not None]
    if len(given) == 1:
        return ""
    has = "both; remove one" if given else "neither; add one"
    return f"{where}: must have either time (a column) or sample_time (seconds), but has {has}"


def without_samples(output: Output, times: Sequence[float], where: str) -> Output:
    """Return an output without its samples at some times, which may contain rounding errors.

    Raises
    ------
    DataError
        If there is no sample at one of the times.
    """
    kept = np.ones(len(output.times), bool)
    for time in times:
        apart = np.abs(output.times - time)
        at = int(np.argmin(apart)) if len(apart) else 0
        if not len(apart) or apart[at] > SAME_TIME * max(abs(time), float(np.ptp(output.times))):
            nearest_time = f"; the nearest is {output.times[at]:.10g} s" if len(apart) else ""
            raise DataError(
                f"{where}: must be the times of samples, but there is no sample at {time:.10g} "
                f"s{nearest_time}; correct or remove this time"
            )
        kept[at] = False
    return output if kept.all() else output.only(kept)


def sigma_without_output(where: str, name: str, outputs: Collection[str]) -> str:
    """Return an error message on a standard deviation for a name that is not an output."""
    return (
        f"{where}.{name}: must be one of the outputs of the experiment, but is "
        f"not{nearest(name, outputs)}"
    )


def relative_without_sigma(where: str, name: str) -> str:
    """Return an error message on a relative sigma without sigma: no noise if the signal is 0."""
    return (
        f"{where}.relative_sigma.{name}: must be given together with sigma.{name}, the noise at a "
        f"signal of 0, but sigma.{name} is missing; add it"
    )
