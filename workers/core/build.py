"""Building the core on this machine, once for each version of its sources.

A wheel carries built libraries; a tree that is installed in place has sources alone, and builds
them with the system's compiler into a cache of this user.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from workers.caches import cache_folder
from workers.errors import ModelError

HERE = Path(__file__).parent
FLAGS = (
    "-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden",
    "-fno-math-errno", "-fomit-frame-pointer",
)  # fmt: skip
"""No contraction of products and sums: it would give other bits on processors that have it."""
COMPILERS = ("gcc", "cc", "clang")
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
CARRIED = HERE / "binaries" / f"core-{sys.platform}-{platform.machine().lower()}{SUFFIX}"
"""Of a wheel."""


def sources(*, own_functions: bool = True) -> list[Path]:
    """Return the files to compile.

    Parameters
    ----------
    own_functions
        With the core's own elementary functions, as far as they are there; else with those of the C
        library, to compare with.
    """
    files = {path.name: path for path in sorted(HERE.glob("*.c"))}
    own = own_functions and "elementary.c" in files
    unused = "elementary_libm.c" if own else "elementary.c"
    return [path for name, path in files.items() if name != unused]


def built(*, own_functions: bool = True) -> Path:
    """Return the library of this version, which is built if it is not there yet.

    Raises
    ------
    ModelError
        If there is no compiler, or it fails.
    """
    if own_functions and CARRIED.is_file():
        return CARRIED
    files = sources(own_functions=own_functions)
    library = _place(files)
    if not library.is_file():
        _build_into(library, files)
    return library


def is_built() -> bool:
    """Return whether the core is there already, so that nobody has to wait some seconds for it."""
    return CARRIED.is_file() or _place(sources()).is_file()


def compile_to(target: Path, files: Sequence[Path], flags: Sequence[str] = FLAGS) -> None:
    """Compile sources to a library or a program.

    Raises
    ------
    ModelError
        If there is no compiler, or it fails.
    """
    command = [compiler(), *flags, *map(str, files), "-I", str(HERE), "-o", str(target), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ModelError(
            f"the simulation core cannot be built: {command[0]} must compile {HERE} but says "
            f"{done.stderr.strip()[-500:]!r}; install another C compiler, or a wheel of cluster-est"
        )


def compiler() -> str:
    """Return the C compiler of this machine; `CC` names another one.

    Raises
    ------
    ModelError
        If there is none.
    """
    for name in (os.environ.get("CC", ""), *COMPILERS):
        if name and (found := shutil.which(name)):
            return found
    raise ModelError(
        "the simulation core must be built on this machine, but there is no C compiler: install "
        "gcc (Debian: apt install gcc), or a wheel of cluster-est, which carries it"
    )


def _place(files: Sequence[Path]) -> Path:
    return cache_folder("core") / f"core-{_version(files)}{SUFFIX}"


def _build_into(library: Path, files: Sequence[Path]) -> None:
    """Build in a folder beside the cache's, and put it there in one go."""
    with tempfile.TemporaryDirectory(prefix=".building-", dir=library.parent) as folder:
        target = Path(folder) / library.name
        compile_to(target, files)
        os.replace(target, library)


def _version(files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in [*files, *sorted(HERE.glob("*.h"))]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    digest.update(" ".join((compiler(), *FLAGS)).encode())
    return digest.hexdigest()[:16]
