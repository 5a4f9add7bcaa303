"""Reads the structure of MAT files of version 5 without SciPy.

SciPy does not check the tags in such a file: a damaged tag may crash the process. So every tag is
checked before SciPy reads the arrays, and SciPy reads nothing else. For the format, see "MAT-File
Format", The MathWorks, 1999 and later, chapter 1.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
NAME_TYPE, COMPRESSED_NAME_TYPE, DIMENSIONS_TYPE, FLAGS_TYPE = 1, 16, 5, 6
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
"""Number of bytes of a number, by type."""
NUMERIC = range(6, 16)
"""Classes of numeric arrays."""
CLASSES = {1: "a cell array", 2: "a structure", 3: "an object", 4: "text", 5: "a sparse matrix"}
STRUCTURE, OPAQUE = 2, 17
VECTORS = "{short}_v = double({it}); save('vectors.mat', '{short}_v', '-v7')"
TYPED_IN_MATLAB = {
    "timeseries": "{short}_s = struct('Time', {it}.Time, 'Data', squeeze({it}.Data)); "
    "save('vectors.mat', '{short}_s', '-v7')",
    "timetable": "writetimetable({it}, '{short}.csv')",
    "table": "writetable({it}, '{short}.csv')",
    "tscollection": "{short}_s = struct({it}); save('vectors.mat', '{short}_s', '-v7')",
    "Simulink.SimulationData.Dataset": "writetimetable(extractTimetable({it}), '{short}.csv')",
    "Simulink.SimulationOutput": "writetimetable(extractTimetable({it}), '{short}.csv')",
    "datetime": "{short}_s = posixtime({it}); save('vectors.mat', '{short}_s', '-v7')",
    "duration": "{short}_s = seconds({it}); save('vectors.mat', '{short}_s', '-v7')",
}
"""MATLAB code that saves an object in a readable file, by class."""
DEEPEST = 8
"""Deepest level of nested structures that is read."""
MOST_ELEMENTS = 100
"""Largest array of structures that is read."""
LONGEST_FIELD_NAME = 1024
MOST_NAMED_FIELDS = 12
COMPLEX = 0x0800
MOST_VARIABLE_BYTES = 2**31
"""Largest size of an unpacked variable in bytes."""


@dataclass(frozen=True)
class MatContents:
    """The contents of a file.

    Attributes
    ----------
    numbers
        Names of the numeric arrays.
    others
        Descriptions of the other variables, by name.
    fields
        A separate MAT file with the numeric arrays in structures, which are named as in MATLAB:
        "log.time". Empty if there are none.
    """

    numbers: tuple[str, ...]
    others: dict[str, str]
    fields: bytes = b""


@dataclass(frozen=True)
class _Variable:
    """A variable, or a field of a variable.

    Attributes
    ----------
    name
        Name, including the names of the structures that contain it.
    what
        Description, if it is not a numeric array.
    matrix
        For a numeric field: its bytes as a variable.
    """

    name: str
    what: str = ""
    matrix: bytes = b""


def contents(file: bytes) -> MatContents | None:
    """Return the contents of a file; None if the file's version has no tags.

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
    fields: dict[str, bytes] = {}
    at = HEADER_BYTES
    while at < len(file):
        kind, size = _unpack(f"{order}II", file, at)
        body = file[at + 8 : at + 8 + size]
        at += 8 + size
        if at > len(file):
            raise ValueError("it is cut off")
        if kind == COMPRESSED:
            body = zlib.decompressobj().decompress(body, MOST_VARIABLE_BYTES)
            kind, size = _unpack(f"{order}II", body, 0)
            body = body[8 : 8 + size]
        if kind != MATRIX:
            raise ValueError(f"a variable is of the unknown kind {kind}")
        for each in _variables(body, order):
            if each.what:
                others[each.name] = each.what
            elif each.matrix:
                fields[each.name] = each.matrix
            else:
                numbers[each.name] = None
    inner = file[:HEADER_BYTES] + b"".join(fields.values()) if fields else b""
    return MatContents(tuple(numbers), others, inner)


def _variables(
    body: bytes, order: str, inside: str = "", own: str = "", depth: int = 0
) -> Iterator[_Variable]:
    """Yield a variable, and the fields of a structure.

    Parameters
    ----------
    body
        Bytes of the variable.
    order
        Byte order.
    inside, own, depth
        For a field: the name of its structure with a point, its own name, and its level.
    """
    at, flags = _element(body, 0, order, (FLAGS_TYPE,))
    (first,) = _unpack(f"{order}I", flags, 0)
    kind = first & 0xFF
    if kind == OPAQUE:
        yield _object(body, at, order, inside, own)
        return
    if kind not in NUMERIC and kind not in CLASSES:
        yield _Variable(inside + own, "of an unknown class")
        return
    at, dimensions = _element(body, at, order, (DIMENSIONS_TYPE,))
    shape = _unpack(f"{order}{len(dimensions) // 4}i", dimensions, 0)
    if not 2 <= len(shape) <= 32 or min(shape) < 0:
        raise ValueError(f"a variable has the dimensions {shape[:4]}")
    before = body[:at]
    at, name = _element(body, at, order, (NAME_TYPE, COMPRESSED_NAME_TYPE))
    whole = inside + (own or name.decode("latin-1"))
    if kind == STRUCTURE and 0 < math.prod(shape) <= MOST_ELEMENTS and depth < DEEPEST:
        yield from _structure(body, at, order, whole, (depth, shape))
        return
    data = at
    for _ in range(0 if kind in CLASSES else 2 if first & COMPLEX else 1):
        at, _ = _element(body, at, order, tuple(SIZES), math.prod(shape))
    sizes = " x ".join(str(n) for n in shape)
    what = f"{CLASSES[kind]} of {sizes}" if kind in CLASSES else ""
    matrix = _named(before, whole, body[data:at], order) if inside and not what else b""
    yield _Variable(whole, what, matrix)


def _object(body: bytes, at: int, order: str, inside: str, own: str) -> _Variable:
    """Return an object of a MATLAB class, whose values have an undocumented format."""
    texts = []
    for _ in range(3):  # name, type system and class
        at, text = _element(body, at, order, (NAME_TYPE, COMPRESSED_NAME_TYPE))
        texts.append(text.decode("latin-1"))
    name, _, kind = texts
    whole = inside + (own or name)
    return _Variable(whole, object_of_matlab(whole, kind))


def object_of_matlab(name: str, kind: str) -> str:
    """Return a description of an object of a MATLAB class, with code to save its numbers.

    The file format of its values is undocumented.
    """
    short = name.rpartition(".")[2]
    typed = TYPED_IN_MATLAB.get(kind, VECTORS).replace("{it}", name).replace("{short}", short)
    return (
        f"a MATLAB object of class {kind}, which only MATLAB can read; to convert it, run this in "
        f"MATLAB: {typed}"
    )


def _structure(
    body: bytes, at: int, order: str, whole: str, place: tuple[int, tuple[int, ...]]
) -> Iterator[_Variable]:
    """Yield a structure and its fields; elements of an array of structures count from 0."""
    depth, shape = place
    count = math.prod(shape)
    at, length = _element(body, at, order, (5,), 1)
    (longest,) = _unpack(f"{order}i", length, 0)
    at, texts = _element(body, at, order, (NAME_TYPE,))
    if not 0 < longest <= LONGEST_FIELD_NAME:
        raise ValueError(f"a structure has names with an impossible length of {longest} bytes")
    names = [
        texts[i : i + longest].split(b"\0")[0].decode("latin-1")
        for i in range(0, len(texts), longest)
    ]
    listed = ", ".join(names[:MOST_NAMED_FIELDS]) or "nothing"
    sizes = f" of {' x '.join(str(n) for n in shape)}" if count > 1 else ""
    yield _Variable(whole, f"a structure{sizes} with {listed}")
    elements = [f"{whole}[{i}]" for i in range(count)] if count > 1 else [whole]
    for element, name in ((element, name) for element in elements for name in names):
        kind, size = _unpack(f"{order}II", body, at)
        if kind != MATRIX or at + 8 + size > len(body):
            raise ValueError(f"a tag says {size} bytes of kind {kind}")
        if size:  # an empty field may have only a tag
            inner = body[at + 8 : at + 8 + size]
            yield from _variables(inner, order, f"{element}.", name, depth + 1)
        at += 8 + size


def _named(before: bytes, name: str, data: bytes, order: str) -> bytes:
    """Return a matrix as a variable with this name."""
    text = name.encode("latin-1")
    named = struct.pack(f"{order}II", NAME_TYPE, len(text)) + text + bytes(-len(text) % 8)
    body = before + named + data
    return struct.pack(f"{order}II", MATRIX, len(body)) + body


def _element(
    body: bytes, at: int, order: str, kinds: tuple[int, ...], count: int | None = None
) -> tuple[int, bytes]:
    """Return the position after an element, and its data, if its kind and size are right."""
    (kind,) = _unpack(f"{order}I", body, at)
    if kind >> 16:  # a small element: kind, size and data in eight bytes
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
