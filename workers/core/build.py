"""The libraries in C: their sources, their platforms, and the places of compiled libraries.

A wheel contains them for all of `PLATFORMS`; `scripts/build_hook.py` builds them. An editable
installation has those of its own machine in the same folder. A missing library is compiled at its
first use into a cache of this user. It is missing if a source has changed or the platform differs.
The file name contains a digest of the sources, so a library of other sources is never used.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from workers.errors import ModelError

HERE = Path(__file__).parent
BINARIES = HERE / "binaries"
"""Folder of compiled libraries in a wheel or an editable installation; git ignores it."""
FLAGS = (
    "-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden",
    "-fno-math-errno", "-fomit-frame-pointer",
)  # fmt: skip
"""Products and sums are not contracted, because the result would depend on the processor."""
COMPILERS = ("gcc", "cc", "clang")

KINDS = {"core": ("*.c",), "wrapper": ("*.c", "wrapper/*.c")}
"""Kinds of libraries, with the patterns of their sources."""

PLATFORMS = {
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
    "x86_64-darwin": "x86_64-macos.11.0",
    "aarch64-darwin": "aarch64-macos.11.0",
}
"""Platforms of a wheel, in the names of FMI 3.0, with zig's names. Zig's names include the oldest
supported system. Without such a name, zig would optimise for the processor of this machine."""


def this_platform() -> str:
    """Return the platform of this Python in the names of FMI 3.0, or a similar name.

    A Linux whose C library is not glibc, such as Alpine, is called `x86_64-linux-musl`.
    """
    machine = platform.machine().lower()
    if sys.platform == "win32":  # Python may be for another processor, which Windows emulates
        machine = sysconfig.get_platform().removeprefix("win-")
    architecture = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    return f"{architecture}-{system}" + ("-musl" if system == "linux" and not _is_glibc() else "")


def suffix(platform: str) -> str:
    """Return the file name suffix of a shared library for a platform."""
    return {"windows": ".dll", "darwin": ".dylib"}.get(platform.split("-")[1], ".so")


def sources(kind: str = "core") -> list[Path]:
    """Return the source files of a library of one of `KINDS`."""
    return sorted(path for pattern in KINDS[kind] for path in HERE.glob(pattern))


def built() -> Path:
    """Return the core's library of this version for this machine; compile it if it is missing.

    Raises
    ------
    ModelError
        If it must be compiled, but there is no compiler or the compiler fails.
    """
    return library("core", this_platform())


def library(kind: str, platform: str) -> Path:
    """Return a library for a platform.

    A missing library is compiled. For this machine, any compiler will do. For another one of
    `PLATFORMS`, the package ziglang is required.

    Parameters
    ----------
    kind
        One of `KINDS`.
    platform
        In the names of FMI 3.0; `this_platform()` returns that of this machine.

    Raises
    ------
    ModelError
        If the library is missing and cannot be compiled.
    """
    carried, cached = carried_path(kind, platform), _cached_path(kind, platform)
    if carried.is_file():
        return carried
    if _is_whole(cached):
        return cached
    if platform == this_platform():
        build_into(cached, lambda target: compile_to(target, sources(kind)))
    elif platform in PLATFORMS and zig() is not None:
        build_into(cached, lambda target: compile_for(platform, target, kind))
    else:
        raise ModelError(missing(kind, platform))
    _noted(cached).write_text(_digest(cached), encoding="ascii")
    return cached


def is_built() -> bool:
    """Return whether the core is already compiled, which otherwise takes some seconds."""
    here = this_platform()
    return carried_path("core", here).is_file() or _is_whole(_cached_path("core", here))


def carried_path(kind: str, platform: str) -> Path:
    """Return the path of a library of this version in a wheel or an editable installation."""
    return BINARIES / _name(kind, platform)


def missing(kind: str, platform: str) -> str:
    """Return a message that a library is missing, and what to do."""
    there = sorted({p for p in PLATFORMS if carried_path(kind, p).is_file()})
    start = (
        f"{BINARIES}: must have the library {kind} of this version for {platform}, but has it for "
        f"{', '.join(there) or 'no platform'}"
    )
    if platform == this_platform():
        return (
            f"{start}, and there is no C compiler to build it. Install gcc (Debian: apt install "
            "gcc; Alpine: apk add gcc musl-dev) or the package ziglang, or name a compiler in CC; "
            f"wheels of cluster-est contain the library for {', '.join(PLATFORMS)}"
        )
    if platform in PLATFORMS:
        return (
            f"{start}; install a wheel of cluster-est, or the package ziglang to build the library"
        )
    return f"{start}; wheels of cluster-est contain the library only for {', '.join(PLATFORMS)}"


def compile_to(target: Path, files: Sequence[Path], flags: Sequence[str] = FLAGS) -> None:
    """Compile sources to a library or a program for this machine.

    Raises
    ------
    ModelError
        If there is no compiler, or the compiler fails.
    """
    _run([*_for_this_machine(), *flags], target, files)


def compile_for(platform: str, target: Path, kind: str = "core") -> None:
    """Compile a library for any platform, with zig.

    Parameters
    ----------
    platform
        One of `PLATFORMS`, or another platform that zig supports.
    target
        The file; on Windows, the compiler also writes an import library beside it.
    kind
        One of `KINDS`.

    Raises
    ------
    ModelError
        If zig is not installed, or if it fails.
    """
    command = [*_zig_for(platform), *FLAGS]
    if suffix(platform) == ".dylib":  # its install name would otherwise be the build path
        command.append(f"-Wl,-install_name,@rpath/{kind}.dylib")
    _run(command, target, sources(kind))


def build_into(place: Path, compiled: Callable[[Path], None]) -> None:
    """Compile a library in a temporary folder, then move it to its place atomically."""
    with tempfile.TemporaryDirectory(prefix=".building-", dir=place.parent) as folder:
        target = Path(folder) / place.name
        compiled(target)
        os.replace(target, place)


def compiler() -> str:
    """Return the C compiler of this machine, or the one that `CC` names.

    Raises
    ------
    ModelError
        If there is none.
    """
    found = system_compiler()
    if found is None:
        raise ModelError(missing("core", this_platform()))
    return found


def system_compiler() -> str | None:
    """Return the C compiler of this machine, or the one that `CC` names; None if there is none."""
    names = (os.environ.get("CC", ""), *COMPILERS)
    return next((found for name in names if name and (found := shutil.which(name))), None)


def zig() -> tuple[str, ...] | None:
    """Return the command of the package ziglang, or None if it is not installed."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    return (sys.executable, "-m", "ziglang", "cc")


def _for_this_machine() -> tuple[str, ...]:
    if system_compiler() is None and zig() is not None:
        return _zig_for(this_platform())
    return (compiler(),)


def _zig_for(platform: str) -> tuple[str, ...]:
    command = zig()
    if command is None:
        raise ModelError(missing("core", platform))
    target = PLATFORMS.get(platform, platform)  # a name with musl is also zig's name
    return (*command, "-target", target, "-fno-sanitize=undefined", "-Wl,-s")


def _run(command: Sequence[str], target: Path, files: Sequence[Path]) -> None:
    linked = ("-lm", "-ldl") if target.suffix == ".so" else ("-lm",)
    call = [*command, *map(str, files), "-I", str(HERE), "-o", str(target), *linked]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ModelError(
            f"{HERE}: the C source cannot be built: the compiler {command[0]} says "
            f"{done.stderr.strip()[-500:]}; if you changed the source, correct it, otherwise name "
            "another C compiler in CC, or install a wheel of cluster-est"
        )


def _cached_path(kind: str, platform: str) -> Path:
    """Return the path of a library in this user's cache."""
    from workers.caches import cache_folder  # the build hook needs no cache and lacks platformdirs

    return cache_folder("core") / _name(kind, platform, os.environ.get("CC", ""))


def _is_whole(library: Path) -> bool:
    """Return whether a cached library exists and is unchanged since it was compiled."""
    from workers.caches import is_mine

    try:
        mine = is_mine(library.lstat()) and library.is_file()
        return mine and _noted(library).read_text(encoding="ascii") == _digest(library)
    except (OSError, ValueError):
        return False


def _noted(library: Path) -> Path:
    return library.with_name(f"{library.name}.sha256")


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _name(kind: str, platform: str, chosen: str = "") -> str:
    digest = hashlib.sha256(" ".join((chosen, *FLAGS)).encode())
    for path in [*sources(kind), *sorted(HERE.rglob("*.h"))]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{kind}-{platform}-{digest.hexdigest()[:16]}{suffix(platform)}"


def _is_glibc() -> bool:
    try:
        return (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc")
    except (AttributeError, ValueError, OSError):
        return False
