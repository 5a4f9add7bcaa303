"""Numbers on their way into variables of an FMU, and back, whatever type the variables are of.

A row of numbers is float64 throughout. Its first columns are float64 variables, which one call
takes together; each other variable, and each array, has a call of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core.types import int32, intp, uintp

from workers.kernels.calling import address_of, c_function, inlined, kernel
from workers.messages import FloatArray, IntArray

TYPES = (
    "Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64",
    "Boolean",
)  # fmt: skip
"""Types of variables that are numbers; what stands here at i is known to loops as i."""
DISCARD, ERROR = 2, 3
"""From DISCARD on a call brought no result; from ERROR on the instance must be reset."""


class Access(NamedTuple):
    """Which variables of an FMU a row of numbers stands for.

    Attributes
    ----------
    reals : (r,)
        Value references of the float64 scalars that the first r columns stand for.
    codes, references : (v,)
        Type and value reference of each other variable.
    firsts : (v + 1,)
        Where the elements of each of them begin, in what follows.
    columns, bases : (e,)
        The column that each element stands in, or -1, and its value then.
    """

    reals: IntArray
    codes: IntArray
    references: IntArray
    firsts: IntArray
    columns: IntArray
    bases: FloatArray


class Cells(NamedTuple):
    """The memory of one variable's value, seen as every type."""

    float64: FloatArray
    float32: FloatArray
    int8: IntArray
    uint8: IntArray
    int16: IntArray
    uint16: IntArray
    int32: IntArray
    uint32: IntArray
    int64: IntArray
    uint64: IntArray


def cells(size: int) -> Cells:
    """Allocate for an array of so many elements."""
    memory = np.zeros(size)
    return Cells(*(memory.view(getattr(np, name)) for name in Cells._fields))


_values = c_function(int32, intp, intp, uintp, intp)
_arrays = c_function(int32, intp, intp, uintp, intp, uintp)


@inlined
def _call(c, function, references, first, count, values, size):  # type: ignore[no-untyped-def]
    at = address_of(references) + 4 * first
    if c.version == 2:
        return _values(function, (c.handle, at, count, address_of(values)))
    return _arrays(function, (c.handle, at, count, address_of(values), size))


@inlined
def set_reals(c, references, values):  # type: ignore[no-untyped-def]
    """Set float64 scalars; values may be longer."""
    count = len(references)
    return _call(c, c.setters[0], references, 0, count, values, count)


@inlined
def get_reals(c, references, values):  # type: ignore[no-untyped-def]
    """Get float64 scalars; values may be longer."""
    count = len(references)
    return _call(c, c.getters[0], references, 0, count, values, count)


@inlined
def set_values(c, access, row, cells):  # type: ignore[no-untyped-def]
    """Set all variables that a row stands for. Returns the worst status."""
    status = 0
    if len(access.reals) > 0:
        status = set_reals(c, access.reals, row)
    if len(access.codes) > 0 and status < DISCARD:
        status = max(status, _set_others(c, access, row, cells))
    return status


@inlined
def get_values(c, access, row, cells):  # type: ignore[no-untyped-def]
    """Get all variables that a row stands for. Returns the worst status."""
    status = 0
    if len(access.reals) > 0:
        status = get_reals(c, access.reals, row)
    if len(access.codes) > 0 and status < DISCARD:
        status = max(status, _get_others(c, access, row, cells))
    return status


@kernel
def _set_others(c, access, row, cells):  # type: ignore[no-untyped-def]
    worst = 0
    for v in range(len(access.codes)):
        first, end = access.firsts[v], access.firsts[v + 1]
        for e in range(first, end):
            column = access.columns[e]
            value = access.bases[e] if column < 0 else row[column]
            _write(c, access.codes[v], value, e - first, cells)
        function = c.setters[access.codes[v]]
        size = end - first
        worst = max(worst, _call(c, function, access.references, v, 1, cells.float64, size))
        if worst >= DISCARD:
            return worst
    return worst


@kernel
def _get_others(c, access, row, cells):  # type: ignore[no-untyped-def]
    worst = 0
    for v in range(len(access.codes)):
        first, end = access.firsts[v], access.firsts[v + 1]
        function = c.getters[access.codes[v]]
        size = end - first
        worst = max(worst, _call(c, function, access.references, v, 1, cells.float64, size))
        if worst >= DISCARD:
            return worst
        for e in range(first, end):
            column = access.columns[e]
            if column >= 0:
                row[column] = _read(c, access.codes[v], e - first, cells)
    return worst


@inlined
def _write(c, code, value, e, cells):  # type: ignore[no-untyped-def]
    """A number into element e, as a C compiler would convert it; booleans are 0 or not."""
    if code == 0:
        cells.float64[e] = value
    elif code == 1:
        cells.float32[e] = np.float32(value)
    elif code == 10 and c.version == 2:
        cells.int32[e] = 1 if value != 0.0 else 0
    elif code == 10:
        cells.uint8[e] = 1 if value != 0.0 else 0
    elif code == 9:
        cells.uint64[e] = np.uint64(value)
    else:
        whole = np.int64(value)
        if code == 2 or code == 3:
            cells.uint8[e] = np.uint8(whole)
        elif code == 4 or code == 5:
            cells.uint16[e] = np.uint16(whole)
        elif code == 6 or code == 7:
            cells.uint32[e] = np.uint32(whole)
        else:
            cells.int64[e] = whole


@inlined
def _read(c, code, e, cells):  # type: ignore[no-untyped-def]
    value = cells.float64[e]
    if code == 1:
        value = np.float64(cells.float32[e])
    elif code == 2:
        value = np.float64(cells.int8[e])
    elif code == 3 or (code == 10 and c.version == 3):
        value = np.float64(cells.uint8[e])
    elif code == 4:
        value = np.float64(cells.int16[e])
    elif code == 5:
        value = np.float64(cells.uint16[e])
    elif code == 6 or code == 10:
        value = np.float64(cells.int32[e])
    elif code == 7:
        value = np.float64(cells.uint32[e])
    elif code == 8:
        value = np.float64(cells.int64[e])
    elif code == 9:
        value = np.float64(cells.uint64[e])
    return value
