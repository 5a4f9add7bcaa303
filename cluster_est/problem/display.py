"""Tables for notebooks, `print` and pandas; times, probabilities and lists as one writes them."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyarrow as pa

from cluster_est.errors import ProblemError

if TYPE_CHECKING:
    import pandas as pd

MOST_PRINTED_ROWS = 50
"""Rows of a table; how many more there are is said."""

_CELL = "text-align:left;padding:0.15em 0.8em 0.15em 0"


@dataclass(frozen=True)
class DisplayTable:
    """A titled table; numbers are shown to six digits, NaN as nothing."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[Sequence[str | float]]


def section(title: str, *tables: DisplayTable) -> str:
    """Tables under a title as HTML. Every text is escaped: names come from files.

    No colour is set, so it reads in light and dark notebooks alike.
    """
    parts = "".join(_table(table) for table in tables if table.rows)
    return f"<div><p><strong>{html.escape(title)}</strong></p>{parts}</div>"


def plain(title: str, *tables: DisplayTable) -> str:
    """Return a title and tables as text, for `print`."""
    lines = [title]
    for table in tables:
        if table.rows:
            lines += ["", table.title, *_aligned(table)]
    return "\n".join(lines)


def as_frame(table: pa.Table) -> pd.DataFrame:
    """Return a table as a frame of pandas.

    Raises
    ------
    ProblemError
        If pandas is not installed.
    """
    try:
        return table.to_pandas()
    except ImportError:
        raise ProblemError(
            "to_frame: needs pandas, which is not installed; run pip install pandas, or use "
            "table(), which returns an Arrow table"
        ) from None


def _aligned(table: DisplayTable) -> list[str]:
    shown, more = table.rows[:MOST_PRINTED_ROWS], len(table.rows) - MOST_PRINTED_ROWS
    cells = [table.head, *([_text(cell) for cell in row] for row in shown)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    return [*lines, f"and {more} more"] if more > 0 else lines


def _table(table: DisplayTable) -> str:
    shown, more = table.rows[:MOST_PRINTED_ROWS], len(table.rows) - MOST_PRINTED_ROWS
    rows = "".join(_row("td", [_text(cell) for cell in row]) for row in shown)
    rest = f"<p>and {more} more</p>" if more > 0 else ""
    return (
        f"<table><caption style='text-align:left'>{html.escape(table.title)}</caption>"
        f"<thead>{_row('th', table.head)}</thead><tbody>{rows}</tbody></table>{rest}"
    )


def _row(tag: str, cells: Sequence[str]) -> str:
    inside = "".join(f"<{tag} style='{_CELL}'>{html.escape(cell)}</{tag}>" for cell in cells)
    return f"<tr>{inside}</tr>"


def _text(value: str | float) -> str:
    if isinstance(value, str):
        return value
    return "" if math.isnan(value) else f"{value:.6g}"


NO_ALTERNATIVE = (
    "if the rest of the model were exact, this would be very strong evidence against all other "
    "candidates"
)
"""What is said of an effect without alternatives; a criterion takes models for exact."""


def readable_time(seconds: float) -> str:
    """Write a time in the unit in which it is easy to read: "3.2 s", "4.5 min", "24 h", "3 d"."""
    for unit, size, most in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < most:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 86_400.0:.3g} d"


def percent(probability: float) -> str:
    """Write a probability in percent, with no more certainty than it has."""
    if probability > 0.99:
        return "more than 99 %"
    return "less than 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def in_a_row(words: Sequence[str]) -> str:
    """Write words with commas, and "and" before the last one."""
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]
