"""The tables of experiments as sources: their used parts, and the columns that no one uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.gaps import RecordGap
from cluster_est.problem.tables.measured import MeasuredColumns
from cluster_est.problem.tables.measured_table import Reading
from cluster_est.problem.tables.stand_ins import FoundStandIn
from workers.messages import FloatArray


@dataclass(frozen=True)
class TableSource:
    """The table of an experiment, and its used part.

    Attributes
    ----------
    experiment
        Id of the experiment.
    path, rows
        Path of the file, and the used rows (from, to); None for all rows.
    time, sample_time
        Column with the times, or seconds between rows.
    used
        Columns that the experiment uses, including the time.
    named
        (config key, column) of each signal, such as ("outputs.y", "position").
    missing
        Numbers that mark missing measurements.
    stand_ins
        Numbers in the used columns that probably mark missing measurements.
    reading
        The options for reading the file.
    test
        The column that distinguishes tests, and its value for this test; None if the file has one
        test.
    notes
        Sentences on how the file was read.
    units
        (column, unit) for units that the file gives with the names.
    gaps
        Gaps in the outputs.
    clocks
        (config key, column) of each input with its own times, such as ("inputs.u.time", "t_u").
    signal_units
        (signal, unit), from `MeasuredColumns.unit`.
    dated
    dated
        Whether the times were counted from a date, or from a time since 1970.
    switches
        Columns of inputs with words such as "on", or with truth values, that are used unchanged.
    """

    experiment: str
    path: Path
    time: str | None
    sample_time: float | None
    rows: tuple[int, int] | None
    used: tuple[str, ...]
    named: tuple[tuple[str, str], ...] = ()
    missing: tuple[float, ...] = ()
    stand_ins: tuple[FoundStandIn, ...] = ()
    reading: Reading = field(default_factory=Reading)
    test: tuple[str, str] | None = None
    notes: tuple[str, ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    gaps: tuple[RecordGap, ...] = ()
    clocks: tuple[tuple[str, str], ...] = ()
    signal_units: tuple[tuple[str, str], ...] = ()
    switches: tuple[str, ...] = ()
    dated: bool = False

    def unused(self) -> UnusedColumns:
        """Read the file again, and return its unused columns.

        The result is empty if the file cannot be read any more, or if its times are not known.
        """
        try:
            table = read_table(self.path, reading=self.reading)
            table = table if self.test is None else table.part(*self.test, self.experiment)
            reader = MeasuredColumns(table, self.experiment, self.rows, missing=self.missing)
            times = reader.times(self.time, self.sample_time, self.used[-1])
        except DataError:
            return UnusedColumns(np.zeros(0), {})
        found = {}
        for name in reader.table.columns:
            if name in self.used or name in reader.table.clocks.values():
                continue
            try:
                values = reader.column(name)
            except DataError:  # the column has no numbers
                continue
            if len(values) == len(times):
                found[name] = values
        return UnusedColumns(times, found)


@dataclass(frozen=True)
class UnusedColumns:
    """Numeric columns that an experiment does not use.

    Attributes
    ----------
    times : (n,)
    values
        Values by column name, each (n,); NaN for missing measurements.
    """

    times: FloatArray
    values: Mapping[str, FloatArray]

    def at(self, name: str, times: FloatArray) -> FloatArray | None:
        """Return a column at other times, with linear interpolation.

        None if the column is constant, has numbers in fewer than half of its rows, or does not
        cover these times.
        """
        values = self.values[name]
        known = np.isfinite(values)
        if 2 * np.count_nonzero(known) < len(values) or not len(times):
            return None
        when, there = self.times[known], values[known]
        if len(when) < 2 or np.ptp(there) == 0.0:
            return None
        step = float(np.median(np.diff(when)))
        if times[0] < when[0] - step or times[-1] > when[-1] + step:
            return None
        return np.asarray(np.interp(times, when, there))
