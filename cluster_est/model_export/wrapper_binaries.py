"""The precompiled library of exported FMUs for each supported platform.

`workers.core.build` manages the libraries; this module uses the platform names of FMI 2.0.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from workers.core import build
from workers.fmu.platforms import PLATFORM

FMI2_PLATFORMS = {
    "linux64": ("x86_64-linux",),
    "win64": ("x86_64-windows",),
    "darwin64": ("x86_64-darwin", "aarch64-darwin"),
}
"""Platforms of FMI 2.0, with those of FMI 3.0; a Mac's library has a part for each processor."""
_MACH_O_PARTS = ((0x01000007, 3, 12), (0x0100000C, 0, 14))
"""Processor type, subtype and page size (as a power of two) of the parts of a universal binary."""


def wrapper_platforms() -> tuple[str, ...]:
    """Return the platforms with a library, in FMI 2.0's names, that of this machine first.

    The library of this machine is compiled if necessary, which takes some seconds.
    """
    others = (p for p in FMI2_PLATFORMS if p != PLATFORM and all(map(_is_there, FMI2_PLATFORMS[p])))
    return (PLATFORM, *others)


def wrapper_binary(platform: str) -> bytes:
    """Return the library for one of these platforms.

    Raises
    ------
    ModelError
        If it is missing and cannot be compiled.
    """
    here = build.this_platform()
    names = FMI2_PLATFORMS.get(platform, ())
    if platform == PLATFORM and (here not in names or not all(map(_is_there, names))):
        names = (here,)  # in an editable installation; FMI 2.0 may have no name for it
    parts = [build.library("wrapper", name).read_bytes() for name in names]
    return parts[0] if len(parts) == 1 else universal_binary(parts)


def _is_there(name: str) -> bool:
    return build.carried_path("wrapper", name).is_file()


def universal_binary(parts: Sequence[bytes]) -> bytes:
    """Join the libraries for Intel and ARM Macs, in this order, into one."""
    header = struct.pack(">II", 0xCAFEBABE, len(parts))
    body = bytearray(4096)
    for (processor, subtype, alignment), part in zip(_MACH_O_PARTS, parts, strict=True):
        body.extend(bytes(-len(body) % 2**alignment))
        header += struct.pack(">5I", processor, subtype, len(body), len(part), alignment)
        body.extend(part)
    body[: len(header)] = header
    return bytes(body)
