"""The library of exported FMUs: the wrapper with the core in it, built once for a platform.

A wheel carries it for all platforms; a tree that is installed in place builds that of this machine,
beside the core in the cache.
"""

from __future__ import annotations

from pathlib import Path

from workers.core import build
from workers.fmu.platforms import PLATFORM, shared_library

FOLDER = build.HERE / "wrapper"
FLAGS = (*build.FLAGS, "-DEXPORT=", "-I", str(FOLDER), "-ldl")
"""The core's own functions are not those of the library."""
PLATFORMS = {
    "linux64": ("x86_64-linux",),
    "win64": ("x86_64-windows",),
    "darwin64": ("x86_64-darwin", "aarch64-darwin"),
}
"""Platforms of a wheel, by FMI 2.0's names, with those of FMI 3.0."""


def wrappers() -> dict[str, Path]:
    """Return the libraries that there are, by FMI 2.0's names of their platforms.

    Raises
    ------
    ModelError
        If there is none for this machine, and it cannot be built.
    """
    carried = {platform: _carried(platform) for platform in (PLATFORM, *PLATFORMS)}
    found = {platform: path for platform, path in carried.items() if path.is_file()}
    if PLATFORM not in found:
        found[PLATFORM] = _built()
    return found


def _carried(platform: str) -> Path:
    return build.CARRIED.parent / shared_library(f"wrapper-{platform}", platform)


def _built() -> Path:
    files = [*build.sources(), *sorted(FOLDER.glob("*.c"))]
    headers = sorted(FOLDER.glob("*.h"))
    library = build.place(files, headers, "wrapper")
    if not library.is_file():
        build.build_into(library, files, FLAGS)
    return library
