"""The table among the rows of a file: its header, a row of units, and the first of its data.

Programs write what they like above a table: serial numbers, dates, comments, empty lines. The
header is the row above the longest run of rows that have as many cells each, and are numbers or
times for the greater part.
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
"""Least share of the cells of a row with data that are numbers or times."""
LEAST_UNITS: Final = 0.5
"""Least share of the cells of a row of units that are units."""
LEAST_ROWS_OF_RIVAL: Final = 3
LEAST_SHARE_OF_RIVAL: Final = 0.9
"""Rows with data, and the share of numbers in them, of what is a table too."""
NO_UNIT: Final = ("-", "1", "none", "n/a", "")
_TIME: Final = re.compile(
    r"\d[\d\s:.,/+TZ-]*( ?[ap]m)?|\d{1,2}[- ][a-z]{3}[- ]\d{2,4}.*", re.IGNORECASE
)
_IN_BRACKETS: Final = re.compile(r"\s*[\[(<]([^\[\](){}<>]*)[\])>]\s*")
Row = Sequence[str]


@dataclass(frozen=True)
class Header:
    """Where a table is.

    Attributes
    ----------
    names
        Of its columns.
    header
        Index of the row with the names; None where there is none.
    first
        Index of the first row with data.
    units
        Of columns, by their position, from a row of their own.
    rows
        Rows with data that follow, as far as they were looked at.
    share
        Of the cells in these rows that are numbers or times.
    rival
        Index of the header of another table above it; None without one.
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
        """Whether it is the header of a table whatever else is in the file."""
        enough = self.rows >= LEAST_ROWS_OF_RIVAL and self.share >= LEAST_SHARE_OF_RIVAL
        return self.header is not None and enough

    @property
    def score(self) -> float:
        """The more a table is one, the larger."""
        return self.rows * self.share


def find_header(rows: Sequence[Row | None], start: int = 0) -> Header | None:
    """Find the table among rows.

    Parameters
    ----------
    rows
        Cells by row; None for a row that is none, as an empty one or a comment.
    start
        The first row that may be its header.

    Returns
    -------
    Header
        None if no row of two or more cells is numbers for the greater part.
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
    """Refuse rows with another table above the one that was found.

    Raises
    ------
    DataError
        With the key that says which is meant.
    """
    if header.rival is not None:
        raise DataError(
            f"must have one table, but has several, with headers in rows {header.rival + 1} and "
            f"{(header.header or 0) + 1}; choose one with skip_rows = {header.rival} or skip_rows "
            f"= {header.header}, or save each table in a file of its own"
        )


def _numbers(row: Row) -> tuple[int, int]:
    """Return how many cells are numbers or times, and how many are not missing."""
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
    """Return the rows of data from one on, without those that are none."""
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
    if len(last) == width - 1 and _are_numbered(rows, data):  # as R writes the names of rows
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
    """Return whether the row above the data has neither names nor units, but units above it.

    As what a logger has stored of each channel: a mean, a sample.
    """
    last, over, names = (rows[i] or () for i in above[:-4:-1])
    if len(last) != width or _are_units(last) or all(cell.strip() for cell in last):
        return False
    return len(over) == width and _are_units(over) and _are_names(names, over, width)


def _are_numbered(rows: Sequence[Row | None], data: Sequence[int]) -> bool:
    """Return whether the first cells of the rows with data count them."""
    there = [row[0].strip(' "') for i in data if (row := rows[i])]
    return there == [str(i) for i in range(1, len(there) + 1)]


def _names_in_front(rows: Sequence[Row | None], run: Sequence[int]) -> bool:
    """Return whether the first row of data has a text where the others have numbers."""
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
    """Return whether names stand above the first row of data, which is no row of units either."""
    names, row = (rows[above[-1]] if above else None) or (), rows[first] or ()
    if not names or len(names) != len(row) or _are_units(row):
        return False
    return not any(is_value(cell.strip()) for cell in names)


def _are_units(row: Row) -> bool:
    there = [cell for cell in map(str.strip, row) if cell not in NO_UNIT]
    known = [cell for cell in there if _is_unit(cell)]
    return bool(known) and len(known) >= LEAST_UNITS * len(there)


def _are_names(row: Row, units: Row, width: int) -> bool:
    """Return whether a row names all columns that have a unit."""
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
