"""Platforms of an FMU's binaries, and the platform of this machine."""

from __future__ import annotations

from collections.abc import Iterable

import fmpy

from workers.fmu.xml import Version

PLATFORM: str = fmpy.platform
"""This machine's platform in the names of FMI 2.0."""
PLATFORM_TUPLE: str = fmpy.platform_tuple
"""This machine's platform in the names of FMI 3.0."""
_SUFFIXES = {"win": ".dll", "darwin": ".dylib"}
_SUFFIX: str = fmpy.sharedLibraryExtension
_BITS_32 = ("linux32", "win32", "darwin32", "x86-linux", "x86-windows", "i686-linux")


def platform_for(version: Version) -> str:
    """Return this machine's platform, in the folder names of a version of FMI."""
    return PLATFORM if version == "2.0" else PLATFORM_TUPLE


def platforms_in(names: Iterable[str]) -> tuple[str, ...]:
    """Return the platforms with a folder of binaries, from the names in an archive."""
    found = {n.split("/")[1] for n in names if n.startswith("binaries/") and n.count("/") > 1}
    return tuple(sorted(found))


def shared_library(name: str, platform: str) -> str:
    """Return the file name of a shared library for a platform in the names of FMI 2.0."""
    if platform == PLATFORM:
        return f"{name}{_SUFFIX}"
    return name + next((s for system, s in _SUFFIXES.items() if platform.startswith(system)), ".so")


def binary_path(version: Version, identifier: str) -> str:
    """Return the path in the archive of an FMU's shared library for this machine."""
    return f"binaries/{platform_for(version)}/{identifier}{_SUFFIX}"


def missing_binary(
    version: Version, identifier: str, names: Iterable[str], has_sources: bool
) -> str | None:
    """Return the end of a sentence that explains why this machine cannot load an FMU.

    None if the FMU has a binary for it. `names` are the archive's files.
    """
    held = frozenset(names)
    wanted, path = platform_for(version), binary_path(version, identifier)
    if path in held:
        return None
    there = platforms_in(held)
    must = f"must have a binary for this machine's platform ({wanted}), but"
    if wanted in there:
        return f"must have the binary {path}, but does not; export the FMU again"
    if there:
        small = [p for p in there if p in _BITS_32]
        note = f" ({' and '.join(small)}: built for 32 bits, which a 64-bit program cannot load)"
        return f"{must} has one for {', '.join(there)}{note if small else ''}; " + (
            f"export it for {wanted}" + (", or compile its sources" if has_sources else "")
        )
    if has_sources:
        return (
            f"{must} has only sources; compile them, for example with the command `fmpy compile`, "
            "or export it with binaries"
        )
    return f"{must} has none for any platform; export it for {wanted}"
