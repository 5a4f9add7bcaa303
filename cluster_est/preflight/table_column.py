"""A column of a measured table: its name, its unit, and properties of its values."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.problem.tables.units import UNIT_SUFFIXES, conversion, is_known
from cluster_est.statistics.noise.estimate import estimate_noise
from cluster_est.statistics.records import OutputRecord, StackedRecords
from workers.messages import FloatArray

MOST_PARTS = 3
"""Largest number of parts of a name that may be a unit, such as "rad_per_s"."""


OF_VALUES = ("data", "values", "value", "signals")
"""Last parts of a name, in lower case, that mean the values of what precedes them."""


@dataclass(frozen=True)
class TableColumn:
    """One column of numbers.

    Attributes
    ----------
    name
        Name in the table.
    plain, unit
        "force" and "N" of "force [N]".
    noise
        A first guess of the standard deviation of its noise, in its unit; 0 without noise.
    jumps
        Number of jumps, if it is constant or changes little between them.
    increases
        Whether it increases from row to row.
    few
        Whether it has much fewer values than another column.
    at_changes
        Whether it seems to be recorded only when it changes.
    stand_ins
        Numbers in it that probably mark missing measurements.
    is_switch
        Whether it contains words such as "on", or truth values, which are read as 1 and 0.
    clock
        The column with its own times, if the file does not say so itself; None for those of the
        rows.
    """

    name: str
    plain: str
    unit: str
    noise: float = 0.0
    jumps: int = 0
    increases: bool = False
    few: bool = False
    at_changes: bool = False
    stand_ins: tuple[float, ...] = ()
    is_switch: bool = False
    clock: TableColumn | None = None

    @property
    def is_held(self) -> bool:
        """Whether it probably keeps each value until the next sample."""
        return self.jumps > 0 or self.at_changes

    @property
    def folded(self) -> str:
        return fold(self.plain)

    @property
    def last_part(self) -> str:
        """The name without its group or structure: "force" of "log.force" and "force.Data"."""
        parts = re.split(r"[./\\]", self.plain)
        while len(parts) > 1 and parts[-1].casefold() in OF_VALUES:
            parts.pop()
        return parts[-1]


def fold(name: str) -> str:
    """Return a name without case, blanks, underscores, brackets: "motorspeed" of "Motor_Speed"."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def split_suffix(name: str, wanted: str) -> tuple[str, str] | None:
    """Return "speed" and "rpm" of "speed_rpm"; None if the end of a name is not a unit.

    Parameters
    ----------
    name
        Name of a column.
    wanted
        The unit of its variable, to which the end of the name must be convertible: "x_m" may be
        measured in metres, but "u_m" of a voltage is not. If it is "", only units of at least two
        letters count, without "min".
    """
    parts = name.split("_")
    for count in range(min(MOST_PARTS, len(parts) - 1), 0, -1):
        plain, tail = "_".join(parts[:-count]), parts[-count:]
        unit = "/".join(part for part in tail if part != "per")
        unit = UNIT_SUFFIXES.get(unit, unit)
        if wanted:
            fits = conversion(unit, wanted) is not None
        else:
            fits = is_known(unit) and len(unit) > 1 and unit != "min"
        if fits and plain.strip("_"):
            return plain.strip("_"), unit
    return None


def with_suffix(column: TableColumn, wanted: str) -> TableColumn:
    """Return a column with the unit at the end of its name, if it has no other unit."""
    found = None if column.unit else split_suffix(column.name, wanted)
    return column if found is None else replace(column, plain=found[0], unit=found[1])


LEAST_GUESSED_NOISE = 1e-3
"""Smallest guess of the noise, as a share of a signal's standard deviation."""
LEAST_SAMPLES_FOR_NOISE = 10
"""Smallest number of samples from which noise is estimated."""
LEAST_EQUAL_VALUES = 5
"""Smallest number of successive equal values that say nothing about the noise."""


def guessed_noise(values: FloatArray) -> float:
    """Estimate the standard deviation of a signal's noise from its differences.

    Stretches of equal values, as of a saturated sensor, are left out. The result is at least a
    fraction of the signal's standard deviation, because no sensor is more accurate.
    """
    finite = values[np.isfinite(values)]
    ends = np.flatnonzero(np.diff(finite, prepend=np.nan, append=np.nan) != 0.0)
    lengths = np.diff(ends)
    moving = finite[np.repeat(lengths < LEAST_EQUAL_VALUES, lengths)]
    if len(moving) >= LEAST_SAMPLES_FOR_NOISE:
        finite = moving
    if len(finite) < LEAST_SAMPLES_FOR_NOISE:
        return 0.0
    whole = OutputRecord(0, 0, slice(0, len(finite)), np.arange(float(len(finite))))
    spread = float(estimate_noise(finite, StackedRecords(("",), (whole,)), finite)[0])
    return max(spread, LEAST_GUESSED_NOISE * float(np.std(finite)))
