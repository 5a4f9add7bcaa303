"""Columns of measured tables that a config does not use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.measured import MeasuredColumns
from cluster_est.problem.tables.stand_ins import FoundStandIn
from workers.messages import FloatArray


@dataclass(frozen=True)
class TableSource:
    """The table of an experiment, and what of it is used.

    Attributes
    ----------
    experiment
        The experiment's id.
    path, rows
        Of the file, and the rows (from, to) that are used; None for all.
    time, sample_time
        Column with the times, or seconds between rows.
    used
        Columns that the experiment uses, the time among them.
    named
        (key of the config, column) of each signal, such as ("outputs.y", "position").
    missing
        Numbers that mean that nothing was measured.
    stand_ins
        Numbers in the columns of its signals that hardly are measurements.
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

    def unused(self) -> UnusedColumns:
        """Read the file again, for its other columns.

        There are none where the file cannot be read any more, or does not say the times.
        """
        try:
            table = read_table(self.path)
            reader = MeasuredColumns(table, self.experiment, self.rows, missing=self.missing)
            times = reader.times(self.time, self.sample_time, self.used[-1])
        except DataError:
            return UnusedColumns(np.zeros(0), {})
        found = {}
        for name in reader.table.columns:
            if name in self.used:
                continue
            try:
                values = reader.column(name)
            except DataError:  # no numbers
                continue
            if len(values) == len(times):
                found[name] = values
        return UnusedColumns(times, found)


@dataclass(frozen=True)
class UnusedColumns:
    """Columns of numbers that an experiment does not use.

    Attributes
    ----------
    times : (n,)
    values
        Each (n,), by the column's name; NaN where nothing was measured.
    """

    times: FloatArray
    values: Mapping[str, FloatArray]

    def at(self, name: str, times: FloatArray) -> FloatArray | None:
        """Return a column at other times, straight between its samples.

        None where it is constant, or has a number in fewer than half of its rows, or ends before
        those times do.
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
