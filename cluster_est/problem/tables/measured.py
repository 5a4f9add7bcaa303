"""Columns of a measured table as signals of an experiment: the rows used, scaled, and checked.

Config files and `Experiment.from_table` both read their columns here.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import MeasuredTable
from cluster_est.problem.tables.stand_ins import is_missing
from workers.fmu.description import nearest
from workers.messages import FloatArray, Input, Interpolation, Output
from workers.messages.signals import check_length, check_times, refuse_value


@dataclass(frozen=True)
class ColumnChange:
    """A change of unit: (column - its mean, if `demean`) * factor + offset."""

    factor: float = 1.0
    offset: float = 0.0
    demean: bool = False


@dataclass(frozen=True)
class MeasuredColumns:
    """Columns of one experiment's table.

    Attributes
    ----------
    table
        The measured file, or a table in memory.
    where
        Opens each message, such as "experiment 'e1'".
    rows
        (from, to): rows from (counted from 0) up to, not with, to; None for all.
    changes
        Of columns, by name.
    missing
        Numbers in the file that mean that nothing was measured; in the time they are times.
    """

    table: MeasuredTable
    where: str
    rows: tuple[int, int] | None = None
    changes: Mapping[str, ColumnChange] = field(default_factory=dict)
    missing: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in self.changes:
            if name not in self.table.columns:
                raise DataError(f"{self.where}.columns: {self.table.without(name)}")

    def times(self, column: str | None, sample_time: float | None, counted: str) -> FloatArray:
        """The time of each used row.

        Parameters
        ----------
        column
            Of the time; None where rows are `sample_time` seconds apart.
        sample_time
            See there.
        counted
            A column that says how many rows there are, where none has the time.
        """
        path = self.table.path
        if column is not None:
            times = replace(self, missing=()).column(column)
            source = f"{path}, column {column!r}"
        else:
            with np.errstate(over="ignore"):
                rows = np.arange(len(self.column(counted)), dtype=np.float64)
                times = rows * (sample_time or 1.0)
            source = f"sample_time = {sample_time}"
        if len(times) < 2:
            raise DataError(
                f"{self.where}: must use at least two rows of {path} but uses {len(times)}; "
                + ("check rows" if self.rows else "it needs measurements below its header")
            )
        check_times(times, f"{self.where}: {source}", lambda i: f"row {self._row(i)}")
        return times

    def driving(
        self,
        times: FloatArray,
        variable: str,
        column: str,
        interpolation: Interpolation,
        key: str,
    ) -> Input:
        """A signal that drives the model, without the rows where it was not measured."""
        values = self._values(times, column, f"{key}.{variable}")
        known = np.isfinite(values)
        return Input(variable, times[known], values[known], interpolation)

    def output(
        self, times: FloatArray, variable: str, column: str, sigma: float, relative_sigma: float
    ) -> Output:
        """A signal that the model should follow, where it was measured."""
        values = self._values(times, column, f"outputs.{variable}")
        measured = np.isfinite(values)
        return Output(variable, times[measured], values[measured], sigma, relative_sigma)

    def points(self, columns: Collection[str]) -> FloatArray:
        """(n, d): the points of a curve, without those of which a part was not measured.

        Raises
        ------
        DataError
            If there are fewer than two.
        """
        found = [self.column(name) for name in columns]
        lengths = {len(values) for values in found}
        if len(lengths) > 1:
            raise DataError(
                f"{self.where}.curve: the columns must have as many rows as each other but have "
                f"{' and '.join(str(n) for n in sorted(lengths))}; choose others"
            )
        points = np.column_stack(found)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) < 2:
            raise DataError(
                f"{self.where}.curve: must have at least two points but has {len(points)} in "
                f"{self.table.path}; check the columns and rows"
            )
        return np.ascontiguousarray(points)

    def column(self, name: str) -> FloatArray:
        """The used rows of a column in its new unit, NaN where nothing was measured."""
        values = self.table.numbers(name, self.where)
        if self.rows is not None:
            first, last = self.rows
            if last > len(values):
                raise DataError(
                    f"{self.where}.rows: must lie within the {len(values)} rows of "
                    f"{self.table.path} but is [{first}, {last}]; lower its end"
                )
            values = values[first:last]
        if self.missing:
            values = np.where(is_missing(values, self.missing), np.nan, values)
        change = self.changes.get(name)
        if change is None:
            return values
        known = np.isfinite(values)
        with np.errstate(over="ignore", invalid="ignore"):
            mean = float(np.mean(values[known])) if change.demean and known.any() else 0.0
            return (values - mean) * change.factor + change.offset

    def _values(self, times: FloatArray, name: str, key: str) -> FloatArray:
        values = self.column(name)
        column = f"column {name!r} of {self.table.path}"
        check_length(values, times, f"{self.where}.{key}: {column}")
        if np.isnan(values).all():
            raise DataError(
                f"{self.where}.{key}: {column} must hold at least one number but is empty in "
                f"these rows; choose another column or remove {key}"
            )
        infinite = np.flatnonzero(np.isinf(values))
        if len(infinite):
            i = int(infinite[0])
            where = f"{self.where}: {self.table.path}, column {name!r}, row {self._row(i)}"
            raise refuse_value(float(values[i]), where, "leave it empty")
        return values

    def _row(self, used: int) -> int:
        """The row in the file of one of the used rows."""
        return self.table.row((self.rows[0] if self.rows else 0) + used)


def interval(
    start: float | None,
    stop: float | None,
    times: FloatArray,
    outputs: Sequence[Output],
    where: str,
) -> tuple[float, float]:
    """The simulated interval: as it is given, else as far as the data goes.

    Raises
    ------
    DataError
        If it is none.
    """
    if start is None:
        start = float(times[0])
    if stop is None:
        stop = float(max((o.times[-1] for o in outputs if len(o.times)), default=times[-1]))
    if not start < stop:
        raise DataError(
            f"{where}.start: must be before stop, {stop:g} s, but is {start:g} s; change one, or "
            "leave both to the data"
        )
    return start, stop


def missing_time(where: str, time: str | None, sample_time: float | None) -> str:
    """The sentence on times that are given twice or not at all; empty if all is well."""
    given = [each for each in (time, sample_time) if each is not None]
    if len(given) == 1:
        return ""
    has = "both; remove one" if given else "neither; add one"
    return f"{where}: must have either time (a column) or sample_time (seconds) but has {has}"


def sigma_without_output(where: str, name: str, outputs: Collection[str]) -> str:
    """The sentence on a standard deviation of what is no output."""
    return f"{where}.{name}: must be named as one of its outputs but is not{nearest(name, outputs)}"


def relative_without_sigma(where: str, name: str) -> str:
    """The sentence on noise that would be 0 where the signal is 0."""
    return (
        f"{where}.relative_sigma.{name}: must have sigma.{name} beside it, the noise where the "
        "signal is 0, but has not; add it"
    )
