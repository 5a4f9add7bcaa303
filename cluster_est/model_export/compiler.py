"""Compiling the wrapper with the system's compiler, and with zig for other platforms."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cluster_est.errors import ModelError

# Reproducible results: no fast-math, and no fused multiply-adds on the processors that have them.
COMPILER_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-Wall", "-Wextra")
"""Options of the C compiler."""
_MACH_O_PARTS = ((0x01000007, 3, 12), (0x0100000C, 0, 14))
"""Processor type, subtype and page size (as a power of two) of the parts of a universal binary."""


@dataclass(frozen=True)
class Platform:
    """A platform that zig compiles for.

    Attributes
    ----------
    targets
        Zig's names for it: several for a Mac, whose library holds one for each processor.
    suffix
        Of its shared libraries.
    options, libraries
        For the compiler and the linker.
    tuples
        FMI 3.0's names for it.
    """

    targets: tuple[str, ...]
    suffix: str
    options: tuple[str, ...]
    libraries: tuple[str, ...]
    tuples: tuple[str, ...]


PLATFORMS = {
    "linux64": Platform(
        ("x86_64-linux-gnu.2.17",), ".so", ("-fPIC",), ("-lm", "-ldl"), ("x86_64-linux",)
    ),
    "win64": Platform(("x86_64-windows-gnu",), ".dll", (), (), ("x86_64-windows",)),
    "darwin64": Platform(
        ("x86_64-macos.11.0", "aarch64-macos.11.0"),
        ".dylib",
        ("-fPIC",),
        (),
        ("x86_64-darwin", "aarch64-darwin"),
    ),
}
"""What the compiler must know of each platform, by FMI 2.0's names."""


def find_compiler() -> tuple[str, ...]:
    """The command of a C compiler: $CC, then cc, gcc, clang, then ``ziglang``.

    Raises
    ------
    ModelError
        If no compiler is found.
    """
    if chosen := os.environ.get("CC", "").strip():
        command = tuple(shlex.split(chosen))
        if shutil.which(command[0]) is None:
            raise ModelError(
                f"--fmu: CC must name a C compiler but is {chosen!r}, which is not here; change or "
                "unset it"
            )
        return command
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return (name,)
    if _has_zig():
        return _zig()
    raise ModelError(
        "--fmu: needs a C compiler but there is none (cc, gcc, clang); install one, or "
        "`pip install 'cluster-est[export]'`, or name it in CC; --ssv, --modelica and --text need "
        "none"
    )


def check_cross_compiler(platforms: Sequence[str]) -> None:
    """Refuse other platforms than this machine's where zig is not installed.

    Raises
    ------
    ModelError
        With what to install.
    """
    if platforms and not _has_zig():
        raise ModelError(
            f"--platforms: needs the package ziglang to compile for {' and '.join(platforms)} but "
            "it is not installed; `pip install 'cluster-est[export]'`, or leave --platforms out to "
            "compile for this machine alone"
        )


def _has_zig() -> bool:
    return importlib.util.find_spec("ziglang") is not None


def _zig() -> tuple[str, ...]:
    return (sys.executable, "-m", "ziglang", "cc")


def compile_library(command: tuple[str, ...], folder: Path, library: str) -> bytes:
    """Compile the C files of a folder into a shared library for this machine, and return it.

    Raises
    ------
    ModelError
        With what the compiler says, if it fails.
    """
    system = () if os.name == "nt" else ("-fPIC",)
    libraries = () if os.name == "nt" else ("-lm", "-ldl")
    if sys.platform == "darwin":
        libraries = ()
    return _compile((*command, *COMPILER_FLAGS, *system), folder, library, libraries)


def compile_for(platform: str, folder: Path, name: str) -> bytes:
    """Compile the C files of a folder into a shared library for a platform, with zig.

    Raises
    ------
    ModelError
        With what the compiler says, if it fails.
    """
    wanted = PLATFORMS[platform]
    parts = [
        _compile(
            (*_zig(), "-target", target, *COMPILER_FLAGS, *wanted.options, "-s"),
            folder,
            name + wanted.suffix,
            wanted.libraries,
        )
        for target in wanted.targets
    ]
    return parts[0] if len(parts) == 1 else _universal_binary(parts)


def _compile(
    command: tuple[str, ...], folder: Path, library: str, libraries: tuple[str, ...]
) -> bytes:
    # Relative names only: the folder is temporary and must leave no trace in the library.
    sources = sorted(file.name for file in folder.glob("*.c"))
    call = [*command, "-shared", "-o", library, *sources, *libraries]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ModelError(
            f"--fmu: {' '.join(command)} must compile the wrapper but fails: "
            f"{' '.join(done.stderr.split())[:600]}; try another compiler in CC"
        )
    return (folder / library).read_bytes()


def _universal_binary(parts: Sequence[bytes]) -> bytes:
    """Join the libraries for Intel and Arm Macs, in this order, into one."""
    header = struct.pack(">II", 0xCAFEBABE, len(parts))
    body = bytearray(4096)
    for (processor, subtype, alignment), part in zip(_MACH_O_PARTS, parts, strict=True):
        body.extend(bytes(-len(body) % 2**alignment))
        header += struct.pack(">5I", processor, subtype, len(body), len(part), alignment)
        body.extend(part)
    body[: len(header)] = header
    return bytes(body)
