"""Tables that a config cannot make of the measured files by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

Row = list[str]


def convert(source: Path, target: Path) -> list[Path]:
    """Write the tables of all sets that need one and are there.

    Parameters
    ----------
    source
        The folder of the measured data, which holds `league`.
    target
        The folder to write to; the same folders are made in it.

    Returns
    -------
    list of Path
        The tables that were written.
    """
    written = []
    for before, (after, change) in CONVERSIONS.items():
        if (source / before).is_file():
            rows = (source / before).read_text(encoding="utf-8").split()
            table = change([row.split(",") for row in rows])
            path = target / after
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("".join(f"{','.join(row)}\n" for row in table), encoding="utf-8")
            written.append(path)
    return written


def without_repeated_times(rows: Iterable[Row]) -> list[Row]:
    """Leave out each row whose first cell is that of the row before."""
    kept: list[Row] = []
    for row in rows:
        if not kept or row[0] != kept[-1][0]:
            kept.append(row)
    return kept


def with_logarithm(rows: Iterable[Row]) -> list[Row]:
    """Put the decimal logarithm in the place of the second column."""
    head, *body = rows
    logged = [[time, repr(math.log10(float(value)))] for time, value in body]
    return [[head[0], f"lg{head[1]}"], *logged]


CONVERSIONS: dict[str, tuple[str, Callable[[Iterable[Row]], list[Row]]]] = {
    "league/battery/hppc.csv": ("league/battery/once.csv", without_repeated_times),
    "league/hiv/hiv.csv": ("league/hiv/lgV.csv", with_logarithm),
}
"""A measured file, the table that is made of it, and how."""
