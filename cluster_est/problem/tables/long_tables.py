"""Long tables with a row for each value: one column names the signal, another has the value.

Databases and PEtab use this format. Each signal becomes a column with some of the rows.
"""

from __future__ import annotations

from dataclasses import replace

from cluster_est.errors import DataError
from cluster_est.problem.tables.measured_table import MeasuredTable

NAME_COLUMNS = ("observableid", "signal", "channel", "variable", "_field", "quantity", "tag")
"""Usual names of the column with the names of the signals, in lower case."""
VALUE_COLUMNS = ("measurement", "value", "_value", "reading")
"""Usual names of the column with the values, in lower case."""


def wide(table: MeasuredTable, names: str, values: str) -> MeasuredTable:
    """Return a long table with a column for each signal.

    Parameters
    ----------
    table
        A table with a row for each value.
    names, values
        The columns with the names and with the values of the signals.

    Raises
    ------
    DataError
        If there are no such columns, or a signal has the name of another column.
    """
    for name in (names, values):
        if name not in table.columns:
            raise DataError(
                f'has no column {name!r}, but the key "long" gives this name; {table.without(name)}'
            )
    signals = table.tests(names, "long")
    others = {name: each for name, each in table.columns.items() if name not in (names, values)}
    for signal in signals:
        if signal in others:
            raise DataError(
                f"must not have the signal {signal!r} in column {names!r}, because a column has "
                "the same name; rename one of the two"
            )
    columns = others | dict.fromkeys(signals, table.columns[values])
    note = f"it has one row for each value; column {names!r} names the {len(signals)} signals"
    return replace(
        table, columns=columns, long_values=values, signals=signals, notes=(*table.notes, note)
    )


def long_columns(names: list[str]) -> tuple[str, str] | None:
    """Return the columns with names and values if column names are those of a long table."""
    found = [
        next((name for name in names if name.casefold() in known), "")
        for known in (NAME_COLUMNS, VALUE_COLUMNS)
    ]
    return (found[0], found[1]) if all(found) else None
