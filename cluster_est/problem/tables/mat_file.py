"""The contents of a MAT file of version 5, seen without SciPy.

SciPy trusts the tags in such a file: where one is damaged, its compiled reader can take the process
with it. So every tag of what it is to read is looked at before, and it is not asked for the rest.
The format: "MAT-File Format", The MathWorks, 1999 and later, chapter 1.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
NAME, COMPRESSED_NAME, DIMENSIONS, FLAGS = 1, 16, 5, 6
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
"""Bytes of a number of each type."""
NUMERIC = range(6, 16)
"""Classes of arrays of numbers."""
CLASSES = {1: "a cell array", 2: "a structure", 3: "an object", 4: "text", 5: "a sparse matrix"}
COMPLEX = 0x0800
MOST_BYTES = 2**31
"""Of one variable, unpacked."""


@dataclass(frozen=True)
class MatContents:
    """Names of the arrays of numbers, and what the other variables are, by name."""

    numbers: tuple[str, ...]
    others: dict[str, str]


def contents(file: bytes) -> MatContents | None:
    """Look at every variable; None if the file is of no version that has tags.

    Raises
    ------
    ValueError
        If a tag is damaged.
    """
    if len(file) < HEADER_BYTES or 0 in file[:4]:
        return None
    little = file[126:128] == b"IM"
    if file[125 if file[126:127] == b"I" else 124] != 1:
        return None
    order = "<" if little else ">"
    numbers: dict[str, None] = {}
    others: dict[str, str] = {}
    at = HEADER_BYTES
    while at < len(file):
        kind, size = _unpack(f"{order}II", file, at)
        body = file[at + 8 : at + 8 + size]
        at += 8 + size
        if at > len(file):
            raise ValueError("it is cut off")
        if kind == COMPRESSED:
            body = zlib.decompressobj().decompress(body, MOST_BYTES)
            kind, size = _unpack(f"{order}II", body, 0)
            body = body[8 : 8 + size]
        if kind != MATRIX:
            raise ValueError(f"a variable is of the unknown kind {kind}")
        name, what = _variable(body, order)
        if what:
            others[name] = what
        else:
            numbers[name] = None
    return MatContents(tuple(numbers), others)


def _variable(body: bytes, order: str) -> tuple[str, str]:
    """The name of a variable, and what it is if it is no array of numbers."""
    at, flags = _element(body, 0, order, (FLAGS,))
    (first,) = _unpack(f"{order}I", flags, 0)
    kind = first & 0xFF
    if kind not in NUMERIC and kind not in CLASSES:
        return "", "of an unknown class"
    at, dimensions = _element(body, at, order, (DIMENSIONS,))
    shape = _unpack(f"{order}{len(dimensions) // 4}i", dimensions, 0)
    if not 2 <= len(shape) <= 32 or min(shape) < 0:
        raise ValueError(f"a variable has the dimensions {shape[:4]}")
    at, name = _element(body, at, order, (NAME, COMPRESSED_NAME))
    for _ in range(0 if kind in CLASSES else 2 if first & COMPLEX else 1):
        at, _ = _element(body, at, order, tuple(SIZES), math.prod(shape))
    return name.decode("latin-1"), CLASSES.get(kind, "")


def _element(
    body: bytes, at: int, order: str, kinds: tuple[int, ...], count: int | None = None
) -> tuple[int, bytes]:
    """Return the position after an element, and its data, if its kind and size are right."""
    (kind,) = _unpack(f"{order}I", body, at)
    if kind >> 16:  # a small one: kind, size and data in eight bytes
        kind, size, begin, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        short = size > 4
    else:
        (size,) = _unpack(f"{order}I", body, at + 4)
        begin, end = at + 8, at + 8 + size + -size % 8
        short = begin + size > len(body)
    if short or kind not in kinds or (count is not None and size != count * SIZES[kind]):
        raise ValueError(f"a tag says {size} bytes of kind {kind}")
    return end, body[begin : begin + size]


def _unpack(layout: str, data: bytes, at: int) -> tuple[int, ...]:
    try:
        return struct.unpack_from(layout, data, at)
    except struct.error:
        raise ValueError("it is cut off") from None
