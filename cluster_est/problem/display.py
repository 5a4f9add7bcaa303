"""Tables for notebooks, `print` and pandas; readable times, probabilities and lists."""

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
"""Largest number of printed rows of a table; the number of further rows follows it."""

LARGEST_PLAIN = 1e7
"""Numbers of this size or above are written with an exponent."""

_CELL = "text-align:left;padding:0.15em 0.8em 0.15em 0"


@dataclass(frozen=True)
class DisplayTable:
    """A table with a title; numbers have six digits, and NaN is an empty cell."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[Sequence[str | float]]


def section(title: str, *tables: DisplayTable) -> str:
    """Return tables under a title as HTML; all texts are escaped, because names come from files.

    It sets no colours, so it is readable in light and dark notebooks.
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
    """Return a table as a pandas DataFrame.

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
"""Remark on an effect without alternatives; an information criterion assumes exact models."""


BETTER = "together with the other effects, it fits better than this effect"
"""Remark on an alternative that is better in the final model than the effect that was chosen."""


SAME_PREDICTION = 0.1
"""Multiple of the noise below which two predictions count as equal."""


def readable_time(seconds: float) -> str:
    """Return a time in a readable unit: "3.2 s", "4.5 min", "24 h" or "3 d"."""
    for unit, size, most in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < most:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 86_400.0:.3g} d"


def percent(probability: float) -> str:
    """Return a probability in percent; never 0 % or 100 %."""
    if probability > 0.99:
        return "more than 99 %"
    return "less than 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def in_percent(part: float, decimals: int = 0) -> str:
    """Return a share in percent, such as "43%"; a part is never rounded up to all of it."""
    said = f"{part:.{decimals}%}"
    if not 0.0 < part < 1.0 or not said.startswith("100"):
        return said
    return in_percent(part, decimals + 1) if decimals < 3 else "more than 99.9%"


def in_sentences(parts: Sequence[str]) -> str:
    """Return texts that are not empty as sentences; the last one has no full stop."""
    first, *others = [part for part in parts if part] or [""]
    return ". ".join([first, *(f"{part[:1].upper()}{part[1:]}" for part in others)])


def in_unit(unit: str) -> str:
    """Return a unit as it follows a number; "" if it is 1 or unknown."""
    return "" if unit in ("", "1") or "?" in unit else f" {unit}"


def plain_number(value: float, digits: int = 4) -> str:
    """Return a number with some digits; large numbers without an exponent, such as 1830."""
    if abs(value) < 10.0**digits or abs(value) >= LARGEST_PLAIN:
        return f"{value:.{digits}g}"
    return f"{value:.0f}"


def in_a_row(words: Sequence[str]) -> str:
    """Return words separated by commas, with "and" before the last word."""
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]
