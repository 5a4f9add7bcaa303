"""Compiling the wrapper with the system's compiler, or with zig where that is installed."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from cluster_est.errors import ModelError

# Reproducible results: no fast-math, and no fused multiply-adds on the processors that have them.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-Wall", "-Wextra")
"""Of the compiler."""


def find_compiler() -> tuple[str, ...]:
    """The command of a C compiler: $CC, then cc, gcc, clang, then ``ziglang``.

    Raises
    ------
    ModelError
        If there is none.
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
    if importlib.util.find_spec("ziglang") is not None:
        return (sys.executable, "-m", "ziglang", "cc")
    raise ModelError(
        "--fmu: needs a C compiler but there is none (cc, gcc, clang); install one, or "
        "`pip install ziglang`, or name it in CC; --ssv, --modelica and --text need none"
    )


def compile_library(command: tuple[str, ...], folder: Path, library: str) -> bytes:
    """Compile the C files of a folder into a shared library and return it.

    Raises
    ------
    ModelError
        With what the compiler says, if it fails.
    """
    sources = sorted(file.name for file in folder.glob("*.c"))
    system = [] if os.name == "nt" else ["-fPIC"]
    libraries = [] if os.name == "nt" else ["-lm", "-ldl"]
    if sys.platform == "darwin":
        libraries = []
    # Relative names only: the folder is temporary and must leave no trace in the library.
    call = [*command, *FLAGS, *system, "-shared", "-o", library, *sources, *libraries]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ModelError(
            f"--fmu: {' '.join(command)} must compile the wrapper but fails: "
            f"{' '.join(done.stderr.split())[:600]}; try another compiler in CC"
        )
    return (folder / library).read_bytes()
