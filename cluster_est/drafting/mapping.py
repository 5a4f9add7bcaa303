"""Columns that a user gives to variables, as in `--map u="Voltage (V)"`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cluster_est.drafting.columns import TableColumns
from cluster_est.errors import ConfigError, DataError, ModelError
from workers.fmu.description import ModelDescription, nearest

TIME = "time"
"""Stands for the time, whatever the FMU calls it."""
MOST_LISTED = 30
"""Columns in a message."""


def read_mapping(texts: Sequence[str]) -> dict[str, str]:
    """Read `VARIABLE=COLUMN` arguments.

    Raises
    ------
    ConfigError
        If one is something else, or a variable is there twice.
    """
    found: dict[str, str] = {}
    for text in texts:
        name, equals, column = (part.strip() for part in text.partition("="))
        if not equals or not name or not column:
            raise ConfigError(
                f"--map: must be VARIABLE=COLUMN but is {text!r}; write it as in "
                "--map u='Voltage (V)'"
            )
        if name in found:
            raise ConfigError(
                f"--map: {name} must be given one column but is given {found[name]!r} and "
                f"{column!r}; remove one"
            )
        found[name] = column
    return found


def check_variables(mapping: Mapping[str, str], description: ModelDescription) -> None:
    """Refuse names of no variable, and of variables that no column can be for.

    Raises
    ------
    ModelError
        With the nearest name.
    """
    measurable = [v.name for v in description.variables.values() if v.is_computed]
    inputs = [v.name for v in description.inputs()]
    for name in mapping:
        if name == TIME:
            continue
        if name not in description.variables:
            known = nearest(name, [TIME, *inputs, *description.outputs, *measurable])
            raise ModelError(f"--map {name}: {description.file} has no variable {name!r}{known}")
        if name not in inputs and name not in measurable:
            variable = description.variables[name]
            what = variable.causality if variable.kind != "string" else "text"
            raise ModelError(
                f"--map {name}: must be an input of {description.file} or something that it "
                f"computes but is a {what}; give the column to another variable"
            )


def check_columns(mapping: Mapping[str, str], tables: Sequence[TableColumns]) -> None:
    """Refuse a column that no table has.

    Raises
    ------
    DataError
        With the nearest column and all others.
    """
    for name, column in mapping.items():
        if any(column in table.named for table in tables):
            continue
        first = tables[0]
        if column in first.unusable:
            raise DataError(
                f"--map {name}: column {column!r} of {first.path} must hold numbers but does not; "
                "mend it, or give another one"
            )
        names = [*first.named]
        found = nearest(column, names)
        if found.endswith("?"):
            listed = ", ".join(repr(each) for each in names[:MOST_LISTED])
            more = len(names) - MOST_LISTED
            found += f" Its columns are {listed}" + (f" and {more} more" if more > 0 else "")
        raise DataError(f"--map {name}: {first.path} has no column {column!r}{found}")
