"""Times of the channels of a file in which groups of them have a rate of their own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cluster_est.problem.tables.measured_table import Column, MeasuredTable
from workers.messages import FloatArray

TIME_NAME = "time"
"""Of the column with times, where all channels share them; else with the group behind a stroke."""


@dataclass
class Clocks:
    """The times of groups of channels, gathered while a file is read."""

    times: dict[str, FloatArray] = field(default_factory=dict)
    groups: dict[str, str] = field(default_factory=dict)

    def add(self, column: str, group: object, times: FloatArray) -> None:
        """Note the times of a column, which are those of its group."""
        self.groups[column] = str(group)
        self.times.setdefault(str(group), times)

    def table(
        self,
        path: Path,
        columns: dict[str, Column],
        unusable: dict[str, str],
        units: dict[str, str],
    ) -> MeasuredTable:
        """Return the table with a column for each different clock."""
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
            rates = f"its channels have {len(different)} different clocks, and each is read with "
            notes = (f"{rates}its own: {', '.join([*different][:6])}",)
        own: dict[str, Column] = {**different, **columns}
        units = dict.fromkeys(different, "s") | units
        clocks = {column: names[group] for column, group in self.groups.items()}
        return MeasuredTable(path, own, unusable, units=units, clocks=clocks, notes=notes)
