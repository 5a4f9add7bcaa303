"""The end of a table in a text file: summaries, end marks and zeros may stand below it.

Loggers write a maximum, a count of samples or "end of file" there, and where the power failed
while a file was written, zeros. Such lines have no value where those of the table have one. A row
of the table that is cut off has one, and is left to be refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cluster_est.problem.tables.cells import MISSING
from cluster_est.problem.tables.formats.header import is_value

TAIL_BYTES: Final = 2**14
"""Bytes of the end in which such lines are looked for."""
MOSTLY: Final = 0.8
"""Least share of the cells of a column that are values, for it to tell a row of the table."""


@dataclass(frozen=True)
class EndOfTable:
    """Where a table ends, and what is below it.

    Attributes
    ----------
    size
        Bytes of the file up to there.
    said
        What is left out, for a sentence.
    """

    size: int
    said: str


def end_of_table(
    path: Path,
    columns: Sequence[Sequence[str]],
    cells_of: Callable[[bytes], list[str] | None],
) -> EndOfTable | None:
    """Find the end of a table that has something below it; None where it goes on to the end.

    Parameters
    ----------
    path
        Of a file that is not packed, in an encoding in which a line ends with one byte.
    columns
        Cells of each column near the beginning of the table.
    cells_of
        The cells of a line; None of a comment.
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
    """Return whether a line belongs to the table, whole or cut off."""
    if any(cells[:1]) and is_value(cells[0]):
        return True
    return len(cells) > place and (
        is_value(cells[place]) or (cells[place] in MISSING and any(cells))
    )
