"""Numbers on their way into variables of an FMU, and back, whatever type the variables are of.

A row of numbers is float64 throughout. Its first columns are float64 variables, which one call
takes together; each other variable, and each array, has a call of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core.types import int32, intp, uintp

from workers.kernels.fmi.calling import address_of, c_function, is_fmi_2, peek, poke
from workers.kernels.fmi.compiling import inlined, subroutine
from workers.messages import IntArray

TYPES = (
    "Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64",
    "Boolean",
)  # fmt: skip
"""Types of variables that are numbers; loops know them by their positions here."""
DISCARD, ERROR = 2, 3
"""From DISCARD on a call brought no result; from ERROR on the instance must be reset."""
CODE, REFERENCE, SIZE, COLUMN, BASE = range(5)
"""Columns of `VariableAccess.elements`."""


class VariableAccess(NamedTuple):
    """The variables of an FMU that the columns of a row of numbers belong to.

    Attributes
    ----------
    reals : (r,)
        Value references of the float64 scalars of the first r columns.
    elements : (e, 5)
        A row for each element of each other variable: the variable's type, value reference and
        number of elements; the column of this element or, if it has none, -1 and the bits of its
        value.
    """

    reals: IntArray
    elements: IntArray


_values = c_function(int32, intp, intp, uintp, intp)
_arrays = c_function(int32, intp, intp, uintp, intp, uintp)


@inlined
def set_reals(c, references, values):  # type: ignore[no-untyped-def]
    """Set float64 scalars; values may be longer."""
    at, count, first = address_of(references), len(references), address_of(values)
    if is_fmi_2(c):
        return _values(c.set_real, (c.handle, at, count, first))
    return _arrays(c.set_real, (c.handle, at, count, first, count))


@inlined
def get_reals(c, references, values):  # type: ignore[no-untyped-def]
    """Get float64 scalars; values may be longer."""
    at, count, first = address_of(references), len(references), address_of(values)
    if is_fmi_2(c):
        return _values(c.get_real, (c.handle, at, count, first))
    return _arrays(c.get_real, (c.handle, at, count, first, count))


@inlined
def set_values(c, access, row, buffer):  # type: ignore[no-untyped-def]
    """Set all variables of a row. Returns the worst status."""
    status = 0
    if len(access.reals) > 0:
        status = set_reals(c, access.reals, row)
    if len(access.elements) > 0 and status < DISCARD:
        status = max(
            status,
            _set_elements(
                2 if is_fmi_2(c) else 3, c.handle, c.accessors, access.elements, row, buffer
            ),
        )
    return status


@inlined
def get_values(c, access, row, buffer):  # type: ignore[no-untyped-def]
    """Get all variables of a row. Returns the worst status."""
    status = 0
    if len(access.reals) > 0:
        status = get_reals(c, access.reals, row)
    if len(access.elements) > 0 and status < DISCARD:
        status = max(
            status,
            _get_elements(
                2 if is_fmi_2(c) else 3, c.handle, c.accessors, access.elements, row, buffer
            ),
        )
    return status


@inlined
def get_first(c, access, buffer):  # type: ignore[no-untyped-def]
    """Get the first variable of a row into `buffer`. Returns the status."""
    if len(access.reals) > 0:
        return get_reals(c, access.reals[:1], buffer)
    if len(access.elements) > 0:
        return _get_first_element(
            2 if is_fmi_2(c) else 3, c.handle, c.accessors, access.elements, buffer
        )
    return 0


@subroutine
def _get_first_element(version, handle, accessors, elements, buffer):  # type: ignore[no-untyped-def]
    function = accessors[0, elements[0, CODE]]
    return _call(version, handle, function, elements, 0, elements[0, SIZE], buffer)


@subroutine
def _set_elements(version, handle, accessors, elements, row, buffer):  # type: ignore[no-untyped-def]
    status, first = 0, 0
    while first < len(elements) and status < DISCARD:
        code, size = elements[first, CODE], elements[first, SIZE]
        for e in range(size):
            column = elements[first + e, COLUMN]
            value = buffer[0] if column < 0 else row[column]
            if column < 0:
                value = peek(address_of(elements) + 8 * (5 * (first + e) + BASE), np.float64(0.0))
            _write(version, code, value, address_of(buffer), e)
        status = max(
            status, _call(version, handle, accessors[1, code], elements, first, size, buffer)
        )
        first += size
    return status


@subroutine
def _get_elements(version, handle, accessors, elements, row, buffer):  # type: ignore[no-untyped-def]
    status, first = 0, 0
    while first < len(elements):
        code, size = elements[first, CODE], elements[first, SIZE]
        status = max(
            status, _call(version, handle, accessors[0, code], elements, first, size, buffer)
        )
        if status >= DISCARD:
            break
        for e in range(size):
            column = elements[first + e, COLUMN]
            if column >= 0:
                row[column] = _read(version, code, address_of(buffer), e)
        first += size
    return status


@inlined
def _call(version, handle, function, elements, first, size, buffer):  # type: ignore[no-untyped-def]
    """Get or set one variable, whose value is in `buffer`."""
    at = address_of(elements) + 8 * (5 * first + REFERENCE)  # its lower half, in little-endian
    if version == 2:
        return _values(function, (handle, at, 1, address_of(buffer)))
    return _arrays(function, (handle, at, 1, address_of(buffer), size))


@inlined
def _write(version, code, value, at, e):  # type: ignore[no-untyped-def]
    """Write a number into element e, as a C compiler would convert it; booleans are 0 or not."""
    if code == 0:
        poke(at + 8 * e, value)
    elif code == 1:
        poke(at + 4 * e, np.float32(value))
    elif code == 10 and version == 2:
        poke(at + 4 * e, np.int32(value != 0.0))
    elif code == 10:
        poke(at + e, np.uint8(value != 0.0))
    elif code == 9:
        poke(at + 8 * e, np.uint64(value))
    elif code == 8:
        poke(at + 8 * e, np.int64(value))
    elif code == 2 or code == 3:
        poke(at + e, np.uint8(np.int64(value)))
    elif code == 4 or code == 5:
        poke(at + 2 * e, np.uint16(np.int64(value)))
    else:
        poke(at + 4 * e, np.uint32(np.int64(value)))


@inlined
def _read(version, code, at, e):  # type: ignore[no-untyped-def]
    value = peek(at + 8 * e, np.float64(0.0)) if code == 0 else 0.0
    if code == 1:
        value = np.float64(peek(at + 4 * e, np.float32(0.0)))
    elif code == 2:
        value = np.float64(peek(at + e, np.int8(0)))
    elif code == 3 or (code == 10 and version == 3):
        value = np.float64(peek(at + e, np.uint8(0)))
    elif code == 4:
        value = np.float64(peek(at + 2 * e, np.int16(0)))
    elif code == 5:
        value = np.float64(peek(at + 2 * e, np.uint16(0)))
    elif code == 6 or code == 10:
        value = np.float64(peek(at + 4 * e, np.int32(0)))
    elif code == 7:
        value = np.float64(peek(at + 4 * e, np.uint32(0)))
    elif code == 8:
        value = np.float64(peek(at + 8 * e, np.int64(0)))
    elif code == 9:
        value = np.float64(peek(at + 8 * e, np.uint64(0)))
    return value
