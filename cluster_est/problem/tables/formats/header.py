"""Finds a table among the rows of a file: its header, a row of units, and its first data row.

Programs write serial numbers, dates, comments or empty lines above a table. The header is the row
above the longest sequence of rows with the same number of cells, of which at least half are numbers
or times.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from cluster_est.errors import DataError
from cluster_est.problem.tables.cells import MISSING, looks_like_a_number
from cluster_est.problem.tables.units import UNIT_SUFFIXES, is_known

LEAST_NUMBERS: Final = 0.5
"""Least share of numbers or times in a data row."""
LEAST_UNITS: Final = 0.5
"""Least share of units in a row of units."""
LEAST_ROWS_OF_RIVAL: Final = 3
LEAST_SHARE_OF_RIVAL: Final = 0.9
"""Least number of data rows, and least share of numbers in them, of another table."""
NO_UNIT: Final = ("-", "1", "none", "n/a", "")
_TIME: Final = re.compile(
    r"\d[\d\s:.,/+TZ-]*( ?[ap]m)?|\d{1,2}[- ][a-z]{3}[- ]\d{2,4}.*", re.IGNORECASE
)
_IN_BRACKETS: Final = re.compile(r"\s*[\[(<]([^\[\](){}<>]*)[\])>]\s*")
Row = Sequence[str]


@dataclass(frozen=True)
class Header:
    """The position of a table, and its columns.

    Attributes
    ----------
    names
        Names of the columns.
    header
        Index of the row with the names; None if there is none.
    first
        Index of the first data row.
    units
        Units by column position, from a separate row.
    rows
        Number of data rows in the examined part.
    share
        Share of numbers or times in the cells of these rows.
    rival
        Index of the header of another table above; None if there is none.
    """

    names: tuple[str, ...]
    header: int | None
    first: int
    units: dict[int, str]
    rows: int
    share: float
    rival: int | None = None

    @property
    def is_certain(self) -> bool:
        """Whether this is certainly a table, even if there is another table."""
        enough = self.rows >= LEAST_ROWS_OF_RIVAL and self.share >= LEAST_SHARE_OF_RIVAL
        return self.header is not None and enough

    @property
    def score(self) -> float:
        """A measure of how likely this is a table: the larger, the more likely."""
        return self.rows * self.share


def find_header(rows: Sequence[Row | None], start: int = 0) -> Header | None:
    """Find the table among rows.

    Parameters
    ----------
    rows
        Cells by row; None for an empty row or a comment.
    start
        The first row that may be the header.

    Returns
    -------
    Header
        None if there are no data rows with two or more cells.
    """
    numbers = [None if row is None else _numbers(row) for row in rows]
    runs: list[list[int]] = []
    at = start
    while at < len(rows):
        run = _run(rows, numbers, at)
        runs += [run] if run else []
        at = run[-1] + 1 if run else at + 1
    if not runs:
        return None
    longest = max(runs, key=len)
    found = _header(rows, numbers, longest, start)
    others = [_header(rows, numbers, run, start) for run in runs if run[0] < longest[0]]
    rivals = [each for each in others if each is not None and each.is_certain]
    return found if found is None or not rivals else replace(found, rival=rivals[0].header)


def refuse_several(header: Header) -> None:
    """Refuse a file with another table above the one that was found.

    Raises
    ------
    DataError
        If there is another table.
    """
    if header.rival is not None:
        raise DataError(
            f"must have one table, but has several, with headers in rows {header.rival + 1} and "
            f"{(header.header or 0) + 1}; choose one with skip_rows = {header.rival} or skip_rows "
            f"= {header.header}, or save each table in a file of its own"
        )


def _numbers(row: Row) -> tuple[int, int]:
    """Return the number of cells that are numbers or times, and that of nonmissing cells."""
    there = [cell for cell in map(str.strip, row) if cell not in MISSING]
    return sum(is_value(cell) for cell in there), len(there)


def is_value(cell: str) -> bool:
    """Return whether a cell is a number or a time."""
    return looks_like_a_number(cell) or _TIME.fullmatch(cell) is not None


def _is_data(counts: tuple[int, int]) -> bool:
    return counts[0] > 0 and counts[0] >= LEAST_NUMBERS * counts[1]


def _run(
    rows: Sequence[Row | None], numbers: Sequence[tuple[int, int] | None], at: int
) -> list[int]:
    """Return the consecutive data rows from a row on, without empty rows and comments."""
    found: list[int] = []
    width = 0
    for i in range(at, len(rows)):
        row, counts = rows[i], numbers[i]
        if row is None or counts is None:
            if not found:
                return []
            continue
        empty = bool(found) and not counts[1]
        if len(row) < 2 or not (empty or _is_data(counts)) or (width and len(row) != width):
            break
        width = len(row)
        found.append(i)
    return found


def _header(
    rows: Sequence[Row | None],
    numbers: Sequence[tuple[int, int] | None],
    run: list[int],
    start: int,
) -> Header | None:
    first = rows[run[0]]
    width = len(first or ())
    own = [counts for i in run if (counts := numbers[i]) is not None]
    share = sum(n for n, _ in own) / max(sum(n for _, n in own), 1)
    above = [i for i in range(start, run[0]) if rows[i] is not None]
    data = run
    if len(run) > 1 and _names_in_front(rows, run) and not _is_named(rows, above, run[0]):
        above, data = [*above, run[0]], run[1:]
    where = above[-1] if above else None
    if where is None:
        names = tuple(f"column{i + 1}" for i in range(width))
        return Header(names, None, data[0], {}, len(data), share)
    while len(above) > 2 and _is_over_units(rows, above, width):
        where = above[-2]
        above.pop()
    last = rows[where] or ()
    if len(last) == width - 1 and _are_numbered(rows, data):  # row names, as written by R
        last = ("row", *last)
    if len(last) != width:
        return None
    units: dict[int, str] = {}
    over = rows[above[-2]] if len(above) > 1 else None
    if over is not None and _are_units(last) and _are_names(over, last, width):
        units = {i: bare for i, cell in enumerate(last) if (bare := _bare(cell)) not in NO_UNIT}
        where, last = above[-2], over
    names = tuple(" ".join(cell.split()) for cell in last)
    return Header(names, where, data[0], units, len(data), share)


def _is_over_units(rows: Sequence[Row | None], above: Sequence[int], width: int) -> bool:
    """Return whether the row above the data has no names or units, but a row of units above it.

    Loggers write the kind of stored value there, such as a mean or a sample.
    """
    last, over, names = (rows[i] or () for i in above[:-4:-1])
    if len(last) != width or _are_units(last) or all(cell.strip() for cell in last):
        return False
    return len(over) == width and _are_units(over) and _are_names(names, over, width)


def _are_numbered(rows: Sequence[Row | None], data: Sequence[int]) -> bool:
    """Return whether the first cells of the data rows are the row numbers from 1 on."""
    there = [row[0].strip(' "') for i in data if (row := rows[i])]
    return there == [str(i) for i in range(1, len(there) + 1)]


def _names_in_front(rows: Sequence[Row | None], run: Sequence[int]) -> bool:
    """Return whether the first data row has a text in a column of numbers."""
    first = rows[run[0]] or ()
    rest = [row for i in run[1:] if (row := rows[i]) is not None]
    for i, cell in enumerate(first):
        text = cell.strip()
        if text in MISSING or is_value(text):
            continue
        others = [each for row in rest if (each := row[i].strip()) not in MISSING]
        if others and all(is_value(each) for each in others):
            return True
    return False


def _is_named(rows: Sequence[Row | None], above: Sequence[int], first: int) -> bool:
    """Return whether there are names above the first data row, and it is not a row of units."""
    names, row = (rows[above[-1]] if above else None) or (), rows[first] or ()
    if not names or len(names) != len(row) or _are_units(row):
        return False
    return not any(is_value(cell.strip()) for cell in names)


def _are_units(row: Row) -> bool:
    there = [cell for cell in map(str.strip, row) if cell not in NO_UNIT]
    known = [cell for cell in there if _is_unit(cell)]
    return bool(known) and len(known) >= LEAST_UNITS * len(there)


def _are_names(row: Row, units: Row, width: int) -> bool:
    """Return whether a row has names for all columns with a unit."""
    if len(row) != width or any(is_value(cell.strip()) for cell in row if cell.strip()):
        return False
    return all(name.strip() for name, unit in zip(row, units, strict=True) if unit.strip())


def _is_unit(cell: str) -> bool:
    if _IN_BRACKETS.fullmatch(cell) is not None or is_known(cell):
        return True
    return cell in UNIT_SUFFIXES or cell.casefold() in UNIT_SUFFIXES


def _bare(cell: str) -> str:
    """Return a unit without its brackets."""
    found = _IN_BRACKETS.fullmatch(cell)
    text = (found[1] if found is not None else cell).strip()
    return UNIT_SUFFIXES.get(text, UNIT_SUFFIXES.get(text.casefold(), text))
