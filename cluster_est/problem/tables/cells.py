"""Converts cells with text to numbers: decimal and thousands separators, and missing values.

"1,234" may be 1.234 or 1234. This is decided from the other cells of the column, or else from the
other columns of the file. Otherwise the user must decide, because a guess may be wrong by a factor
of a thousand without notice.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, Final

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
"""Cells that mark missing measurements."""
SWITCHES: Final = {
    "true": "1", "false": "0", "on": "1", "off": "0", "ein": "1", "aus": "0", "an": "1",
    "wahr": "1", "falsch": "0", "enabled": "1", "disabled": "0",
}  # fmt: skip
"""Words for 1 and 0, in lower case."""
_SIGN, _END = r"^[+-]?", r"([eE][+-]?\d+)?$"
_GROUPED: Final = {",": rf"{_SIGN}\d{{1,3}}(,\d{{3}})+", ".": rf"{_SIGN}\d{{1,3}}(\.\d{{3}})+"}
_OTHER: Final = {",": ".", ".": ","}
_POINTS: Final = {",": ",", ".": r"\."}
_FORTRAN: Final = r"^([+-]?[0-9.,]+)[dD]([+-]?[0-9]+)$"
"""Double-precision numbers in the notation of Fortran."""
_BLANKS: Final = r"^[+-]?\d{1,3}([ \x{a0}\x{202f}\x{2019}']\d{3})+([.,]\d+)?$"
"""Numbers with blanks or apostrophes as thousands separators."""


class AmbiguousNumberError(ValueError):
    """Raised for a cell whose separator may be a decimal or a thousands separator.

    Attributes
    ----------
    index, cell
        Index and text of the first such cell.
    """

    def __init__(self, index: int, cell: str) -> None:
        super().__init__(cell)
        self.index, self.cell = index, cell


def is_text(column: pa.ChunkedArray) -> bool:
    """Return whether a column contains text."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def is_numeric(column: pa.ChunkedArray) -> bool:
    """Return whether a column contains numbers or Boolean values."""
    kinds = ("floating", "integer", "null", "boolean", "decimal")
    return any(getattr(pa.types, f"is_{kind}")(column.type) for kind in kinds)


def as_numbers(column: pa.ChunkedArray) -> FloatArray:
    """Return the cells as floats; NaN for empty cells."""
    # not safe: integers beyond 2**53, such as times in nanoseconds, are rounded and not refused
    return np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def trimmed_cells(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the texts without surrounding blanks; null for missing measurements."""
    trimmed = pc.utf8_trim_whitespace(column)
    absent = pc.is_in(trimmed, value_set=pa.array(MISSING, trimmed.type))
    return pc.if_else(absent, None, trimmed)


def text_numbers(column: pa.ChunkedArray, given: str, of_file: str) -> FloatArray:
    """Convert texts to numbers; `SWITCHES`, in any case, become 1 and 0.

    Parameters
    ----------
    column
        A column with text.
    given
        The decimal separator that the user gives; "" if none is given.
    of_file
        The decimal separator in other columns of the file. "" if it is not known; a point before
        three digits is then a decimal point. ";" if the point may be a thousands separator.

    Raises
    ------
    AmbiguousNumberError
        If the decimal separator cannot be determined.
    pa.ArrowInvalid
        If a cell is not a number.
    """
    cells = trimmed_cells(column)
    try:
        if not given and of_file in ("", ".") and not _contain(cells, ","):
            return as_numbers(cells)
    except pa.ArrowInvalid:
        pass
    return as_numbers(_switches(_plain(cells, given, of_file)))


def first_text(column: pa.ChunkedArray, given: str, of_file: str) -> int:
    """Return the position of the first cell that is not a number, by bisection."""
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
    """Replace `SWITCHES`, in any case, by 1 and 0."""
    lowered = pc.utf8_lower(cells)
    for word, number in SWITCHES.items():
        cells = pc.if_else(pc.equal(lowered, word), number, cells)
    return cells


def is_switch(column: Any) -> bool:
    """Return whether a column begins with a word such as "on", or contains truth values."""
    if isinstance(column, np.ndarray):
        return bool(column.dtype.kind == "b")
    if not is_text(column):
        return bool(pa.types.is_boolean(column.type))
    there = trimmed_cells(column.slice(0, 1000)).drop_null()
    return len(there) > 0 and str(there[0]).lower() in SWITCHES


def _plain(cells: pa.ChunkedArray, given: str, of_file: str) -> pa.ChunkedArray:
    """Return numbers with a decimal point and without thousands separators."""
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
        if decimal == ",":  # a cell that still has a point is not a number
            cells = pc.replace_substring(cells, other, "?")
    return pc.replace_substring(cells, ",", ".") if decimal == "," else cells


def _decimal_of(cells: pa.ChunkedArray, of_file: str) -> str:
    """Return the decimal separator of a column."""
    comma, point = (_contain_pattern(cells, _surely(sign)) for sign in (",", "."))
    if comma is not point:
        return "," if comma else "."
    if comma or of_file in (".", ","):  # with both kinds, cells with a decimal comma are refused
        return "." if comma else of_file
    if not of_file and not _contain(cells, ","):
        return "."
    found = pc.match_substring_regex(cells, r"[,.]").combine_chunks()
    index = int(pc.index(found, True).as_py())
    raise AmbiguousNumberError(index, cells[index].as_py())


def _surely(sign: str) -> str:
    """Return a pattern for numbers in which this sign is certainly the decimal separator."""
    point, thousands = _POINTS[sign], _POINTS[_OTHER[sign]]
    return (
        rf"{_SIGN}(\d*{point}(\d{{0,2}}|\d{{4,}})|(0\d*|\d{{4,}})?{point}\d{{3}}"
        rf"|\d*{point}\d+[eE][+-]?\d+|\d{{1,3}}({thousands}\d{{3}})+{point}\d*"
        rf"|\d{{1,3}}({thousands}\d{{3}}){{2,}})$"
    )


_SURELY: Final = {sign: re.compile(_surely(sign)) for sign in (",", ".")}
_SEPARATORS: Final = re.compile("[ \u00a0\u202f\u2019']")
_NUMBER: Final = re.compile(
    r"[+-]?(\d+([.,]\d*)*|[.,]\d+)([edED][+-]?\d+)?|[+-]?inf|" + "|".join(SWITCHES), re.I
)


def looks_like_a_number(cell: str) -> bool:
    """Return whether a text is a number in any notation."""
    return _NUMBER.fullmatch(cell) is not None


def without_groups(cell: str) -> str:
    """Return a text without blanks and apostrophes between thousands, with a plain minus sign."""
    return _SEPARATORS.sub("", cell).replace("\u2212", "-")


def decimal_in(cells: Iterable[str]) -> str:
    """Return the decimal separator that follows from some cells of a file.

    It is "" if it does not follow from them, and ";" if they contradict each other.
    """
    kinds = {sign for cell in cells for sign in (",", ".") if _SURELY[sign].match(cell)}
    return ";" if len(kinds) == 2 else kinds.pop() if kinds else ""


def _contain(cells: pa.ChunkedArray, text: str) -> bool:
    return bool(pc.any(pc.match_substring(cells, text)).as_py())


def _contain_pattern(cells: pa.ChunkedArray, pattern: str) -> bool:
    return bool(pc.any(pc.match_substring_regex(cells, pattern)).as_py())
