"""A shared library of Linux, by its bytes: the processor that it is for and what it needs.

The layout is that of the System V Application Binary Interface, chapters 4 and 5
(gabi.xinuos.com). Only what the system's loader reads is read: segments, and no sections, which may
be damaged.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

MACHINES = {3: "x86", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
"""Processors, by e_machine."""
LOADED_SEGMENT, DYNAMIC_SEGMENT = 1, 2
"""Segments, by p_type."""
END_OF_ENTRIES, NEEDED, STRINGS, RPATH, RUNPATH = 0, 1, 5, 15, 29
"""Entries of the dynamic segment, by d_tag."""


class _Layout(NamedTuple):
    """Places and formats in files of one width.

    `table` has e_phoff, `counts` e_phentsize and e_phnum. `segment` reads a program header, of
    which `order` picks p_type, p_offset, p_vaddr and p_filesz. `entry` is one of the dynamic
    segment.
    """

    table: tuple[int, str]
    counts: tuple[int, str]
    segment: str
    order: tuple[int, int, int, int]
    entry: str


_LAYOUTS = {
    1: _Layout((28, "I"), (42, "HH"), "8I", (0, 1, 2, 4), "iI"),
    2: _Layout((32, "Q"), (54, "HH"), "2I6Q", (0, 2, 3, 5), "qQ"),
}
"""By the class of the file: 32 and 64 bits."""


class _Segment(NamedTuple):
    kind: int
    offset: int
    address: int
    size: int


@dataclass(frozen=True)
class ElfLibrary:
    """Processor, dependencies and search folders that a library declares."""

    machine: str
    needed: tuple[str, ...]
    folders: tuple[str, ...]
    """Where it tells to look for them."""


def read_elf(path: Path) -> ElfLibrary | None:
    """Read a library; None if it is none, or damaged, so that nothing is known of it."""
    try:
        content = path.read_bytes()
        return _parsed(content) if content[:4] == b"\x7fELF" else None
    except (OSError, struct.error, ValueError, LookupError, OverflowError):
        return None


def _parsed(content: bytes) -> ElfLibrary:
    layout, order = _LAYOUTS[content[4]], {1: "<", 2: ">"}[content[5]]
    (machine,) = struct.unpack_from(f"{order}H", content, 18)
    segments = [*_segments(content, layout, order)]
    entries = [*_entries(content, segments, layout, order)]
    tables = [value for tag, value in entries if tag == STRINGS]
    texts = {
        kind: tuple(_text(content, segments, tables[0], v) for tag, v in entries if tag == kind)
        for kind in (NEEDED, RPATH, RUNPATH)
    }
    paths = (*texts[RPATH], *texts[RUNPATH])
    return ElfLibrary(
        machine=MACHINES.get(machine, f"other ({machine})"),
        needed=texts[NEEDED],
        folders=tuple(folder for path in paths for folder in path.split(":") if folder),
    )


def _segments(content: bytes, layout: _Layout, order: str) -> Iterator[_Segment]:
    (first,) = struct.unpack_from(order + layout.table[1], content, layout.table[0])
    size, count = struct.unpack_from(order + layout.counts[1], content, layout.counts[0])
    for number in range(count):
        found = struct.unpack_from(order + layout.segment, content, first + number * size)
        yield _Segment(*(found[place] for place in layout.order))


def _entries(
    content: bytes, segments: list[_Segment], layout: _Layout, order: str
) -> Iterator[tuple[int, int]]:
    """Give the entries of the dynamic segment, up to the one that ends them."""
    step = struct.calcsize(order + layout.entry)
    for segment in segments:
        if segment.kind == DYNAMIC_SEGMENT:
            for place in range(segment.offset, segment.offset + segment.size - step + 1, step):
                tag, value = struct.unpack_from(order + layout.entry, content, place)
                if tag == END_OF_ENTRIES:
                    return
                yield tag, value
            return


def _text(content: bytes, segments: list[_Segment], table: int, place: int) -> str:
    """Return a text of the table of strings, which is known by its address in memory."""
    for segment in segments:
        if segment.kind == LOADED_SEGMENT and 0 <= table - segment.address < segment.size:
            begin = table - segment.address + segment.offset + place
            return os.fsdecode(content[begin : content.index(b"\0", begin)])
    raise ValueError("its strings are in no segment")
