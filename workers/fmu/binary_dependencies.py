"""Dependencies of an FMU's shared library, read from its file, to explain why it does not load.

The layout is that of the ELF specification (System V ABI, chapters 4 and 5); where libraries are
searched for is from the manual page ld.so(8).
"""

from __future__ import annotations

import os
import platform
import re
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_CACHE = Path("/etc/ld.so.cache")
_FOLDERS = ("/lib64", "/usr/lib64", "/lib", "/usr/lib", "/usr/local/lib")
_LOAD, _DYNAMIC = 1, 2
_NEEDED, _STRINGS, _RPATH, _RUNPATH = 1, 5, 15, 29
_MACHINES = {3: "x86", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
_TOO_NEW = re.compile(r"version `((?:GLIBC|GLIBCXX|CXXABI|GCC)_[\w.]+)' not found")
_LICENCE = re.compile(r"licen[cs]|flex(lm|net)|check(ed)?[ -]?out", re.IGNORECASE)
_REFUSAL = re.compile(
    r"\b(no|not|\w+n't|without|fail\w*|invalid|expired?|missing|cannot|unable|denied|error|required?"
    r"|needs?|refused|rejected|exceeded)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class _ElfLibrary:
    """Processor, dependencies and search folders that a library declares."""

    machine: str
    needed: tuple[str, ...]
    folders: tuple[str, ...]
    """Where it tells to look for them."""


def missing_libraries(binary: Path) -> tuple[str, ...]:
    """Names of the shared libraries that a library needs and this machine would not find.

    Those that lie where the library itself tells to look are followed. Nothing is loaded. Empty if
    the file is no ELF library, or this is not Linux.
    """
    if not sys.platform.startswith("linux"):
        return ()
    missing: dict[str, None] = {}
    waiting, seen = [binary], {binary}
    while waiting:
        path = waiting.pop()
        elf = _read(path)
        if elf is None:
            continue
        for name in elf.needed:
            location = _declared_location(path, elf, name)
            if location is not None and location not in seen:
                seen.add(location)
                waiting.append(location)
            elif location is None and not _is_installed(name):
                missing[name] = None
    return tuple(sorted(missing))


def load_failure(binary: Path, system_message: str = "") -> str | None:
    """Explain why a library cannot be loaded here and what to do, as the end of a sentence.

    Parameters
    ----------
    binary
        The FMU's library.
    system_message
        The system's message when it was loaded.

    Returns
    -------
    str | None
        None where nothing is known but what the system said.
    """
    elf = _read(binary)
    if elf is None:
        return None
    here = platform.machine().lower()
    if elf.machine != {"amd64": "x86_64", "arm64": "aarch64"}.get(here, here):
        return (
            f"its library {binary.name} is for {elf.machine} processors, but this machine is of "
            f"{here}; export it for this machine"
        )
    missing = missing_libraries(binary)
    if missing:
        beside = [name for name in missing if (binary.parent / name).is_file()]
        if len(beside) == len(missing):
            return (
                f"its library {binary.name} needs {_listed(missing)}, beside it, where the system "
                f"does not look; set LD_LIBRARY_PATH to {binary.parent} and start again"
            )
        absent = [name for name in missing if name not in beside]
        plural = "libraries" if len(absent) > 1 else "library"
        return f"it needs the shared {plural} {_listed(absent)}, which this machine lacks; " + (
            "install them" if len(absent) > 1 else "install it"
        )
    found = _TOO_NEW.search(system_message)
    if found:
        return (
            f"it was built for a newer system, with {found.group(1)}, than this machine has; "
            "export it on an older one, or use a newer one here"
        )
    return None


def is_about_licence(text: str) -> bool:
    """Return whether a message of an FMU says that a licence was refused."""
    return bool(_LICENCE.search(text) and _REFUSAL.search(text))


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _read(path: Path) -> _ElfLibrary | None:
    try:
        return _parse(path.read_bytes())
    except (OSError, struct.error, ValueError, IndexError, OverflowError):  # damaged in any way
        return None


def _parse(data: bytes) -> _ElfLibrary | None:
    if data[:4] != b"\x7fELF" or data[4] not in (1, 2) or data[5] not in (1, 2):
        return None
    wide, order = data[4] == 2, "<" if data[5] == 1 else ">"
    (machine,) = struct.unpack_from(order + "H", data, 18)
    segments = list(_segments(data, wide, order))
    dynamic = [s for s in segments if s[0] == _DYNAMIC]
    loads = [s for s in segments if s[0] == _LOAD]
    entries = list(_entries(data, dynamic[0], wide, order)) if dynamic else []
    tables = [value for tag, value in entries if tag == _STRINGS]
    strings = _offset(tables[0], loads) if tables else 0

    def texts(*tags: int) -> list[str]:
        starts = [strings + value for tag, value in entries if tag in tags]
        return [data[s : data.index(0, s)].decode(errors="replace") for s in starts]

    folders = [f for text in texts(_RPATH, _RUNPATH) for f in text.split(":") if f]
    return _ElfLibrary(
        machine=_MACHINES.get(machine, f"other ({machine})"),
        needed=tuple(texts(_NEEDED)),
        folders=tuple(folders),
    )


_Segment = tuple[int, int, int, int]
"""Kind, offset in the file, address in memory, size in the file."""


def _segments(data: bytes, wide: bool, order: str) -> Iterator[_Segment]:
    (start,) = struct.unpack_from(order + ("Q" if wide else "I"), data, 32 if wide else 28)
    size, count = struct.unpack_from(order + "HH", data, 54 if wide else 42)
    for i in range(count):
        at = start + i * size
        if wide:
            kind, _, offset, address, _, length = struct.unpack_from(order + "IIQQQQ", data, at)
        else:
            kind, offset, address, _, length = struct.unpack_from(order + "IIIII", data, at)
        yield kind, offset, address, length


def _entries(data: bytes, segment: _Segment, wide: bool, order: str) -> Iterator[tuple[int, int]]:
    layout = order + ("QQ" if wide else "II")
    _, offset, _, length = segment
    for at in range(offset, offset + length, struct.calcsize(layout)):
        tag, value = struct.unpack_from(layout, data, at)
        if tag == 0:
            return
        yield tag, value


def _offset(address: int, loads: list[_Segment]) -> int:
    for _, offset, start, length in loads:
        if start <= address < start + length:
            return offset + address - start
    raise ValueError("an address that is in no segment")


def _declared_location(path: Path, elf: _ElfLibrary, name: str) -> Path | None:
    """Return the library's path in the folders that the one that needs it declares."""
    if "/" in name:
        return Path(name) if Path(name).is_file() else None
    origin = str(path.parent)
    for folder in elf.folders:
        plain = folder.replace("${ORIGIN}", origin).replace("$ORIGIN", origin)
        if (Path(plain) / name).is_file():
            return Path(plain) / name
    return None


def _is_installed(name: str) -> bool:
    """Return whether the system's loader finds a library in its folders or its cache."""
    try:
        if b"\0" + name.encode() + b"\0" in _CACHE.read_bytes():
            return True
    except OSError:
        pass  # systems without a cache have their folders alone
    machine = platform.machine()
    given = [f for f in os.environ.get("LD_LIBRARY_PATH", "").split(":") if f]
    usual = [*_FOLDERS, f"/lib/{machine}-linux-gnu", f"/usr/lib/{machine}-linux-gnu"]
    return any((Path(folder) / name).is_file() for folder in [*given, *usual])
