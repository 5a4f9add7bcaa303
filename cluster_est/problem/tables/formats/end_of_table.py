"""Finds the end of a table in a text file with other lines below the table.

Loggers write a maximum, the number of samples or "end of file" there. A power failure while the
file is written may leave zeros. Such lines have no value in the column in which table rows have
one. A truncated row has such a value, so it is kept and later refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cluster_est.problem.tables.cells import MISSING
from cluster_est.problem.tables.formats.header import is_value

TAIL_BYTES: Final = 2**14
"""Number of bytes at the end of the file in which such lines are searched for."""
MOSTLY: Final = 0.8
"""Least share of values in a column that identifies rows of the table."""


@dataclass(frozen=True)
class EndOfTable:
    """The end of a table, and the lines below it.

    Attributes
    ----------
    size
        Number of bytes of the file up to the end of the table.
    said
        Note on the lines that are ignored.
    """

    size: int
    said: str


def end_of_table(
    path: Path,
    columns: Sequence[Sequence[str]],
    cells_of: Callable[[bytes], list[str] | None],
) -> EndOfTable | None:
    """Find the end of a table with lines below it; None if the table ends with the file.

    Parameters
    ----------
    path
        Path of an uncompressed file, in an encoding with one byte per line break.
    columns
        Cells of each column near the beginning of the table.
    cells_of
        A function that returns the cells of a line; None for a comment.
    """
    shares = [sum(map(is_value, cells)) / max(len(cells), 1) for cells in columns]
    place = next((i for i, share in enumerate(shares) if share >= MOSTLY), None)
    if place is None:
        return None
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(size - TAIL_BYTES, 0))
        tail = file.read()
    bare = tail.rstrip(b"\0")
    end, lines = len(bare), 0
    for line in reversed(bare.splitlines(keepends=True)):
        cells = cells_of(line)
        if cells is None or _is_row(cells, place):
            break
        end -= len(line)
        lines += any(cells)
    zeros = len(bare) < len(tail)
    if end <= 0 or not (lines or zeros):
        return None
    parts = [f"{lines} line{'s' if lines > 1 else ''}"] if lines else []
    parts += ["zeros"] if zeros else []
    said = f"lines below its table are ignored: {' and '.join(parts)}"
    return EndOfTable(size - len(tail) + end, said)


def _is_row(cells: Sequence[str], place: int) -> bool:
    """Return whether a line is a row of the table, which may be truncated."""
    if any(cells[:1]) and is_value(cells[0]):
        return True
    return len(cells) > place and (
        is_value(cells[place]) or (cells[place] in MISSING and any(cells))
    )
