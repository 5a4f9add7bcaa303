"""Plain tables for notebooks and `print`, of problems and of results."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

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
