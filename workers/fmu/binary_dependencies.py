"""Dependencies of an FMU's shared library, read from its file, to explain why it does not load.

pyelftools reads the file; the search rules are those of the manual page ld.so(8).
"""

from __future__ import annotations

import os
import platform
import re
import sys
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from elftools.elf.dynamic import DynamicSegment, DynamicTag
from elftools.elf.elffile import ELFFile
from elftools.elf.enums import ENUM_E_MACHINE

_CACHE = Path("/etc/ld.so.cache")
_FOLDERS = ("/lib64", "/usr/lib64", "/lib", "/usr/lib", "/usr/local/lib")
_MACHINES = {
    "EM_386": "x86",
    "EM_ARM": "arm",
    "EM_X86_64": "x86_64",
    "EM_AARCH64": "aarch64",
    "EM_RISCV": "riscv64",
}
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
    """Folders in which the library declares that its dependencies are."""


def missing_libraries(binary: Path) -> tuple[str, ...]:
    """Return the shared libraries that a library needs and that this machine would not find.

    Dependencies in folders that a library declares are followed recursively. Nothing is loaded. The
    result is empty if the file is not an ELF library, or if this system is not Linux.
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
    """Return the end of a sentence that explains why a library cannot be loaded, with advice.

    Parameters
    ----------
    binary
        The FMU's library.
    system_message
        The system's message from the attempt to load it.

    Returns
    -------
    str | None
        None if nothing more than the system's message is known.
    """
    elf = _read(binary)
    if elf is None:
        return None
    here = platform.machine().lower()
    if elf.machine != {"amd64": "x86_64", "arm64": "aarch64"}.get(here, here):
        return (
            f"its library {binary.name} is for {elf.machine} processors, but this machine has an "
            f"{here} processor; export it for this machine"
        )
    missing = missing_libraries(binary)
    if missing:
        beside = [name for name in missing if (binary.parent / name).is_file()]
        if len(beside) == len(missing):
            return (
                f"its library {binary.name} needs {_listed(missing)}, which are in the library's "
                f"folder, where the system does not look; set LD_LIBRARY_PATH to {binary.parent} "
                "and start cluster-est again"
            )
        absent = [name for name in missing if name not in beside]
        plural = "libraries" if len(absent) > 1 else "library"
        return f"it needs the shared {plural} {_listed(absent)}, which this machine lacks; " + (
            "install them" if len(absent) > 1 else "install it"
        )
    found = _TOO_NEW.search(system_message)
    if found:
        return (
            f"it was built for a newer system than this machine has (it needs {found.group(1)}); "
            "export it on an older system, or use a newer system here"
        )
    return None


def is_about_licence(text: str) -> bool:
    """Return whether an FMU's message reports a refused licence."""
    return bool(_LICENCE.search(text) and _REFUSAL.search(text))


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _read(path: Path) -> _ElfLibrary | None:
    try:
        with path.open("rb") as file:
            return _parse(ELFFile(file))
    except Exception:  # a damaged file may raise any exception in the parser
        return None


def _parse(elf: ELFFile) -> _ElfLibrary | None:
    """Read only the segments, as the system's loader does; the sections may be damaged."""
    elf.header["e_shoff"] = 0
    tags: list[DynamicTag] = []
    segment = next(elf.iter_segments(type="PT_DYNAMIC"), None)
    if isinstance(segment, DynamicSegment):
        most = segment["p_filesz"] // elf.structs.Elf_Dyn.sizeof()
        tags = list(islice(segment.iter_tags(), most))
    needed = _texts(tags, "NEEDED")
    paths = [*_texts(tags, "RPATH"), *_texts(tags, "RUNPATH")]
    if "" in needed:  # the name lies beyond the end of the file
        return None
    machine = elf["e_machine"]
    return _ElfLibrary(
        machine=_MACHINES.get(machine, f"other ({ENUM_E_MACHINE.get(machine, machine)})"),
        needed=tuple(needed),
        folders=tuple(folder for path in paths for folder in path.split(":") if folder),
    )


def _texts(tags: list[DynamicTag], kind: str) -> list[str]:
    return [str(getattr(t, kind.lower())) for t in tags if t.entry.d_tag == f"DT_{kind}"]


def _declared_location(path: Path, elf: _ElfLibrary, name: str) -> Path | None:
    """Return the path of a dependency in the folders that a library declares, or None."""
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
        pass  # a system without this cache
    machine = platform.machine()
    given = [f for f in os.environ.get("LD_LIBRARY_PATH", "").split(":") if f]
    usual = [*_FOLDERS, f"/lib/{machine}-linux-gnu", f"/usr/lib/{machine}-linux-gnu"]
    return any((Path(folder) / name).is_file() for folder in [*given, *usual])
