"""Cells of a measured column: text into numbers, and what is no number."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute

from workers.messages import FloatArray

MISSING = ["", "NaN", "nan", "NAN", "NA", "N/A", "null", "None"]


def is_text(column: pa.ChunkedArray) -> bool:
    """Return True for a column of texts."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def is_numeric(column: pa.ChunkedArray) -> bool:
    """Return True for a column of numbers, or of true and false."""
    kinds = ("floating", "integer", "null", "boolean", "decimal")
    return any(getattr(pa.types, f"is_{kind}")(column.type) for kind in kinds)


def trimmed_cells(column: pa.ChunkedArray, *, decimal_comma: bool) -> pa.ChunkedArray:
    """Text ready to be numbers: without blanks, null where nothing was measured."""
    trimmed = pa.compute.utf8_trim_whitespace(column)
    if decimal_comma and not pa.compute.any(pa.compute.match_substring(trimmed, ".")).as_py():
        trimmed = pa.compute.replace_substring(trimmed, ",", ".")
    absent = pa.compute.is_in(trimmed, value_set=pa.array(MISSING, trimmed.type))
    return pa.compute.if_else(absent, None, trimmed)


def with_switches(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """Text in which True and False, in any case, are 1 and 0."""
    lowered = pa.compute.utf8_lower(cells)
    for word, number in (("true", "1"), ("false", "0")):
        cells = pa.compute.if_else(pa.compute.equal(lowered, word), number, cells)
    return cells


def as_numbers(column: pa.ChunkedArray) -> FloatArray:
    """Return the cells as floats, NaN where there is none."""
    # unsafe: integers beyond 2**53, like times in nanoseconds, are rounded rather than refused
    return np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def first_text(cells: pa.ChunkedArray) -> int:
    """Position of the first cell that is no number, by halving."""
    good, bad = 0, len(cells)
    while bad - good > 1:
        middle = (good + bad) // 2
        try:
            as_numbers(cells.slice(good, middle - good))
            good = middle
        except pa.ArrowInvalid:
            bad = middle
    return good
