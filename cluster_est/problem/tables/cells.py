"""Cells of text as numbers: decimals, thousands, and what means that nothing was measured.

"1,234" may be 1.234 or 1234. The other cells of its column tell, else those of the file, else the
user: a guess would be wrong in silence by a factor of a thousand.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from workers.messages import FloatArray

MISSING = [
    "", "NaN", "nan", "NAN", "-nan", "NA", "N/A", "n/a", "#N/A", "#NV", "null", "NULL", "None",
    "-", "--", "---", "1.#QNAN", "-1.#IND", "*", "**", "***", "****", "?", "#DIV/0!", "#VALUE!",
    "#WERT!", "#REF!", "#BEZUG!", "#NUM!", "#ZAHL!", "#NAME?", "No Data", "no data", "NoData",
    "undefined", "Undefined", "missing", "Missing", "invalid", "Invalid", "Bad", "bad",
    "I/O Timeout",
]  # fmt: skip
"""Cells that mean that nothing was measured."""
_SIGN, _END = r"^[+-]?", r"([eE][+-]?\d+)?$"
_GROUPED: Final = {",": rf"{_SIGN}\d{{1,3}}(,\d{{3}})+", ".": rf"{_SIGN}\d{{1,3}}(\.\d{{3}})+"}
_OTHER: Final = {",": ".", ".": ","}
_POINTS: Final = {",": ",", ".": r"\."}
_FORTRAN: Final = r"^([+-]?[0-9.,]+)[dD]([+-]?[0-9]+)$"
"""Numbers of double precision as Fortran writes them."""
_BLANKS: Final = r"^[+-]?\d{1,3}([ \x{a0}\x{202f}\x{2019}']\d{3})+([.,]\d+)?$"
"""Thousands that are separated by blanks or apostrophes."""


class AmbiguousNumberError(ValueError):
    """A cell has either decimals or thousands, and nothing tells which.

    Attributes
    ----------
    index, cell
        The first such cell.
    """

    def __init__(self, index: int, cell: str) -> None:
        super().__init__(cell)
        self.index, self.cell = index, cell


def is_text(column: pa.ChunkedArray) -> bool:
    """Return True for a column of texts."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def is_numeric(column: pa.ChunkedArray) -> bool:
    """Return True for a column of numbers, or of true and false."""
    kinds = ("floating", "integer", "null", "boolean", "decimal")
    return any(getattr(pa.types, f"is_{kind}")(column.type) for kind in kinds)


def as_numbers(column: pa.ChunkedArray) -> FloatArray:
    """Return the cells as floats, NaN for empty ones."""
    # unsafe: integers beyond 2**53, like times in nanoseconds, are rounded rather than refused
    return np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def trimmed_cells(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Text without blanks around it, null where nothing was measured."""
    trimmed = pc.utf8_trim_whitespace(column)
    absent = pc.is_in(trimmed, value_set=pa.array(MISSING, trimmed.type))
    return pc.if_else(absent, None, trimmed)


def text_numbers(column: pa.ChunkedArray, given: str, of_file: str) -> FloatArray:
    """Numbers that stand as text; true and false, on and off, in any case, are 1 and 0.

    Parameters
    ----------
    column
        Of text.
    given
        The sign before decimals, if the user has said it; else "".
    of_file
        The sign before decimals in other columns of the file; "" if they do not tell, so that a
        point before three digits is one; ";" if it may separate thousands then.

    Raises
    ------
    AmbiguousNumberError
        If it is neither said nor told.
    pa.ArrowInvalid
        If a cell is no number.
    """
    cells = trimmed_cells(column)
    try:
        if not given and of_file in ("", ".") and not _contain(cells, ","):
            return as_numbers(cells)
    except pa.ArrowInvalid:
        pass
    return as_numbers(_switches(_plain(cells, given, of_file)))


def first_text(column: pa.ChunkedArray, given: str, of_file: str) -> int:
    """Position of the first cell that is no number, by halving."""
    cells = _switches(_plain(trimmed_cells(column), given, of_file))
    good, bad = 0, len(cells)
    while bad - good > 1:
        middle = (good + bad) // 2
        try:
            as_numbers(cells.slice(good, middle - good))
            good = middle
        except pa.ArrowInvalid:
            bad = middle
    return good


def _switches(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """Text in which true and false, on and off, in any case, are 1 and 0."""
    lowered = pc.utf8_lower(cells)
    for word, number in (("true", "1"), ("false", "0"), ("on", "1"), ("off", "0")):
        cells = pc.if_else(pc.equal(lowered, word), number, cells)
    return cells


def _plain(cells: pa.ChunkedArray, given: str, of_file: str) -> pa.ChunkedArray:
    """Numbers with a point before their decimals, and nothing between thousands."""
    cells = pc.replace_substring(cells, "\u2212", "-")
    if _contain_pattern(cells, _FORTRAN):
        cells = pc.replace_substring_regex(cells, _FORTRAN, r"\1e\2")
    if _contain(cells, "'") or _contain_pattern(cells, "[ \u00a0\u202f\u2019]"):
        bare = pc.replace_substring_regex(cells, r"[ \x{a0}\x{202f}\x{2019}']", "")
        cells = pc.if_else(pc.match_substring_regex(cells, _BLANKS), bare, cells)
    if not _contain_pattern(cells, "[,.]"):
        return cells
    decimal = given or _decimal_of(cells, of_file)
    other = _OTHER[decimal]
    if _contain(cells, other):
        bare = pc.replace_substring(cells, other, "")
        pattern = _GROUPED[other] + rf"({_POINTS[decimal]}\d*)?" + _END
        cells = pc.if_else(pc.match_substring_regex(cells, pattern), bare, cells)
        if decimal == ",":  # what is left of the other sign is no number
            cells = pc.replace_substring(cells, other, "?")
    return pc.replace_substring(cells, ",", ".") if decimal == "," else cells


def _decimal_of(cells: pa.ChunkedArray, of_file: str) -> str:
    """Return the sign before decimals in a column."""
    comma, point = (_contain_pattern(cells, _surely(sign)) for sign in (",", "."))
    if comma is not point:
        return "," if comma else "."
    if comma or of_file in (".", ","):  # of both kinds: the other one is refused
        return "." if comma else of_file
    if not of_file and not _contain(cells, ","):
        return "."
    found = pc.match_substring_regex(cells, r"[,.]").combine_chunks()
    index = int(pc.index(found, True).as_py())
    raise AmbiguousNumberError(index, cells[index].as_py())


def _surely(sign: str) -> str:
    """Return a pattern of what only numbers with decimals behind a sign are."""
    point, thousands = _POINTS[sign], _POINTS[_OTHER[sign]]
    return (
        rf"{_SIGN}(\d*{point}(\d{{0,2}}|\d{{4,}})|(0\d*|\d{{4,}})?{point}\d{{3}}"
        rf"|\d*{point}\d+[eE][+-]?\d+|\d{{1,3}}({thousands}\d{{3}})+{point}\d*"
        rf"|\d{{1,3}}({thousands}\d{{3}}){{2,}})$"
    )


_SURELY: Final = {sign: re.compile(_surely(sign)) for sign in (",", ".")}
_SEPARATORS: Final = re.compile("[ \u00a0\u202f\u2019']")
_NUMBER: Final = re.compile(
    r"[+-]?(\d+([.,]\d*)*|[.,]\d+)([edED][+-]?\d+)?|[+-]?inf|true|false|on|off", re.I
)


def looks_like_a_number(cell: str) -> bool:
    """Return whether a text is a number, of whatever spelling."""
    return _NUMBER.fullmatch(cell) is not None


def without_groups(cell: str) -> str:
    """Return a text without what may separate its thousands, and with a plain minus sign."""
    return _SEPARATORS.sub("", cell).replace("\u2212", "-")


def decimal_in(cells: Iterable[str]) -> str:
    """Return the sign before decimals that some cells of a file tell.

    It is "" if they do not, and ";" if some tell one and others the other.
    """
    kinds = {sign for cell in cells for sign in (",", ".") if _SURELY[sign].match(cell)}
    return ";" if len(kinds) == 2 else kinds.pop() if kinds else ""


def _contain(cells: pa.ChunkedArray, text: str) -> bool:
    return bool(pc.any(pc.match_substring(cells, text)).as_py())


def _contain_pattern(cells: pa.ChunkedArray, pattern: str) -> bool:
    return bool(pc.any(pc.match_substring_regex(cells, pattern)).as_py())
