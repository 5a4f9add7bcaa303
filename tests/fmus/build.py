"""Build the test models: one C source each, as FMI 2.0 and as FMI 3.0, in both interfaces.

A model is a folder in ``tests/fmus/models`` with ``model.toml`` (the variables) and ``model.c``
(the equations). The scaffold in ``tests/fmus/common`` keeps to the standard strictly: a call that
is not allowed in the phase of the instance is an error with a message that says so.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from build_fmus import FMI_HEADERS, write_archive
from fmus.description import model_description
from fmus.header import header
from fmus.variables import MODELS, Model, read_model

PLATFORM = {2: "linux64", 3: "x86_64-linux"}
CFLAGS = ["-std=gnu11", "-ffp-contract=off", "-fvisibility=hidden", "-Wall", "-Wextra"]
CFLAGS += ["-Werror", "-fPIC", "-shared", f"-I{FMI_HEADERS}"]


def names() -> list[str]:
    """Return the names of all test models."""
    return sorted(file.parent.name for file in MODELS.glob("*/model.toml"))


def versions(name: str) -> list[int]:
    """Return the versions of the standard that a test model is built for."""
    return [fmi for fmi in (2, 3) if fmi in read_model(name, fmi).spec.get("fmi", [2, 3])]


def build(name: str, fmi: int, out: Path, optimise: str = "-O2") -> Path:
    """Build a test model.

    Parameters
    ----------
    name : str
        The name of its folder.
    fmi : {2, 3}
        The version of the standard.
    out : Path
        The folder for the archive.
    optimise : str, optional
        How hard the compiler tries; it takes twice as long with ``-O2`` as with ``-O0``.

    Returns
    -------
    Path
        The archive, named after the model and the version.
    """
    model = read_model(name, fmi)
    platform = model.spec.get("platform", PLATFORM[fmi])
    suffix = ".dll" if platform == "win64" else ".so"
    files = {
        "modelDescription.xml": model_description(model),
        f"binaries/{platform}/{name}{suffix}": compile_model(model, optimise),
    }
    files |= {f"{folder}/": b"" for folder in model.spec.get("folders", [])}
    path = out / f"{name}_fmi{fmi}.fmu"
    write_archive(path, files)
    return path


def compile_model(model: Model, optimise: str = "-O2") -> bytes:
    """Compile a model into a shared library and return it."""
    generated = {
        "version.h": f"#define FMI {model.fmi}\n".encode(),
        "model_variables.h": header(model).encode(),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, text in {**model.sources, **generated}.items():
            Path(folder, name).write_bytes(text)
        sources = sorted(name for name in model.sources if name.endswith(".c"))
        link = ["-o", "model.so", *sources, "-lm"]
        if absent := model.spec.get("needs_library"):
            command = ["cc", "-shared", "-o", f"lib{absent}.so", "-x", "c", "/dev/null"]
            subprocess.run(command, cwd=folder, check=True)
            link += ["-L.", "-Wl,--no-as-needed", f"-l{absent}"]
        subprocess.run(["cc", *CFLAGS, optimise, *link], cwd=folder, check=True)
        return Path(folder, "model.so").read_bytes()
