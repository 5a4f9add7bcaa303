"""Columns with another unit in their name than that of their variable."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from cluster_est.config.sections import Config
from cluster_est.drafting.columns import split_suffix, split_unit
from cluster_est.problem.tables.units import UnitConversion, conversion, same_unit
from workers.fmu.description import ModelDescription

LEAST_LETTERS = 2
"""Of a unit at the end of a name: "x_m" may be a measured x, "x_mm" is not."""


@dataclass(frozen=True)
class UnitMismatch:
    """A column without a conversion in the config, though it seems to be in another unit.

    Attributes
    ----------
    column, unit
        Its name, and the unit in it.
    variable, wanted
        Its variable, and the variable's unit.
    change
        The conversion from one to the other.
    """

    column: str
    unit: str
    variable: str
    wanted: str
    change: UnitConversion


def unit_mismatches(config: Config, description: ModelDescription) -> list[UnitMismatch]:
    """Return each such column once, whatever the number of experiments that have it.

    A column with an entry under `columns` in the config is left out, and so is one whose unit is
    not known.
    """
    pairs = (
        pair
        for experiment in config.experiments
        for pair in [
            ("time", experiment.time),
            *((name, each.column) for name, each in experiment.inputs.items()),
            *((name, each.column) for name, each in experiment.outputs.items()),
        ]
        if pair[1] not in experiment.columns
    )
    return list(_mismatches(dict.fromkeys(pairs), description))


def _mismatches(
    pairs: dict[tuple[str, str | None], None], description: ModelDescription
) -> Iterator[UnitMismatch]:
    for variable, column in pairs:
        found = description.variables.get(variable)
        wanted = "s" if found is None else found.unit
        unit = _unit(column or "", wanted)
        if not unit or not wanted or same_unit(unit, wanted):
            continue
        change = conversion(unit, wanted)
        if change is not None and change != UnitConversion(1.0):
            yield UnitMismatch(column or "", unit, variable, wanted, change)


def _unit(column: str, wanted: str) -> str:
    """Return the unit in a column's name; at its end only one that can hardly be a word."""
    unit = split_unit(column)[1]
    found = None if unit or not wanted else split_suffix(column, wanted)
    return unit if found is None or len(found[1]) < LEAST_LETTERS else found[1]
