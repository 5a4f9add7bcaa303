"""Build the example FMUs from their equations and a table of variables.

A model is a folder with ``model.toml`` (the variables) and ``model.c`` (the equations).
Together with the shared scaffold in ``configs/models/common`` they become an FMI 2.0 archive
for model exchange and co-simulation::

    python scripts/build_fmus.py [NAME ...] [--out DIR] [--compiler cc|zig] [--platforms ...]
"""

from __future__ import annotations

import argparse
import hashlib
import re
import subprocess
import sys
import tempfile
import tomllib
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fmpy

from cluster_est.model_export.wrapper_binaries import FMI2_PLATFORMS, universal_binary
from workers.core import build as core_build
from workers.fmu.platforms import shared_library

MODELS = Path(__file__).resolve().parent.parent / "configs" / "models"
SCAFFOLD = MODELS / "common"
FMI_HEADERS = Path(fmpy.__file__).parent / "c-code"

# For reproducible results: no fast-math, and no fused multiply-adds.
CFLAGS = ["-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-Wall", "-Wextra"]

ROLES = ["independent", "parameter", "input", "state", "derivative", "output"]


@dataclass(frozen=True)
class Variable:
    """One real variable of a model.

    Parameters
    ----------
    name : str
        Name in the model description.
    role : str
        One of `ROLES`, in whose order value references are given.
    spec : dict
        The remaining keys of the variable in ``model.toml``.
    state : str, optional
        The state that a derivative belongs to.
    """

    name: str
    role: str
    spec: dict[str, Any]
    state: str | None = None

    @property
    def identifier(self) -> str:
        """The name in C: ``der(x)`` becomes ``der_x``."""
        return re.sub(r"\W+", "_", self.name).strip("_")

    @property
    def settable(self) -> str:
        """The phases, as named in C, in which a value may be set."""
        if self.role == "input" or self.spec.get("variability") == "tunable":
            return "ALWAYS"
        return "BEFORE_START" if self.role in ("parameter", "state") else "NEVER"


@dataclass(frozen=True)
class Model:
    """A model read from its folder, with its variables in the order of their value references."""

    name: str
    spec: dict[str, Any]
    variables: list[Variable]
    sources: dict[str, bytes]

    @property
    def guid(self) -> str:
        """A hash of the complete definition of the model."""
        digest = hashlib.sha256(repr(self.spec).encode())
        for name, text in sorted(self.sources.items()):
            digest.update(name.encode() + text)
        return "{" + digest.hexdigest()[:32] + "}"

    def of(self, role: str) -> list[Variable]:
        """Return the variables of one role."""
        return [v for v in self.variables if v.role == role]

    def first(self, role: str) -> int:
        """Return the first value reference of a role."""
        return sum(ROLES.index(v.role) < ROLES.index(role) for v in self.variables)

    def index(self, name: str) -> int:
        """Return the index of a variable in the model description, which counts from 1."""
        return 1 + [v.name for v in self.variables].index(name)


def read_model(folder: Path) -> Model:
    """Read a model's variables and sources.

    Parameters
    ----------
    folder : Path
        The folder with ``model.toml`` and ``model.c``; its name is the model's.

    Returns
    -------
    Model
    """
    spec = tomllib.loads((folder / "model.toml").read_text(encoding="utf-8"))
    files = [folder / "model.c", SCAFFOLD / "fmi2_model.c", SCAFFOLD / "fmi2_model.h"]
    sources = {file.name: file.read_bytes().replace(b"\r\n", b"\n") for file in files}
    return Model(folder.name, spec, read_variables(spec["variable"]), sources)


def read_variables(entries: Iterable[dict[str, Any]]) -> list[Variable]:
    """Convert the entries of ``model.toml`` to variables, ordered by role."""
    variables = [Variable("time", "independent", {"unit": "s", "description": "time"})]
    for entry in entries:
        if rate := entry.get("derivative"):
            variables.append(Variable(entry["name"], "state", entry))
            variables.append(Variable(rate["name"], "derivative", rate, entry["name"]))
        else:
            variables.append(Variable(entry["name"], entry["causality"], entry))
    return sorted(variables, key=lambda v: ROLES.index(v.role))


def c_array(items: Iterable[str]) -> str:
    """Return the initialiser of a C array."""
    return "{" + ", ".join(items) + "}"


def c_header(model: Model) -> str:
    """Return ``model_variables.h``, which declares the variables for all C sources."""
    firsts = {f"FIRST_{role.upper()}": model.first(role) for role in ROLES[2:5]}
    names = [f"V_{v.identifier}" for v in model.variables]
    constants = [*names, "N_VARIABLES", *(f"{name} = {first}" for name, first in firsts.items())]
    quoted = (f'"{v.name}"' for v in model.variables)
    starts = (repr(float(v.spec.get("start", 0.0))) for v in model.variables)
    nominals = (repr(float(v.spec.get("nominal", 1.0))) for v in model.of("state"))
    return "\n".join(
        [
            "/* Generated from model.toml. */",
            f'#define MODEL_NAME "{model.name}"',
            f'#define MODEL_GUID "{model.guid}"',
            f"#define MAX_STEP {float(model.spec['max_step'])!r}",
            f"enum {c_array(constants)};",
            f"#define N_STATES {len(model.of('state'))}",
            f"#define NAMES {c_array(quoted)}",
            f"#define STARTS {c_array(starts)}",
            f"#define NOMINALS {c_array(nominals)}",
            f"#define SETTABLE_PHASES {c_array(v.settable for v in model.variables)}",
            "",
        ]
    )


def element(parent: ET.Element, tag: str, **attributes: object) -> ET.Element:
    """Append a child; attributes that are None are omitted, numbers and Booleans are converted."""
    given = {key: value for key, value in attributes.items() if value is not None}
    texts = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in given.items()}
    return ET.SubElement(parent, tag, texts)


def add_interfaces(root: ET.Element, model: Model) -> None:
    """Describe the capabilities of the FMU in model exchange and in co-simulation."""
    shared = {
        "modelIdentifier": model.name,
        "canNotUseMemoryManagementFunctions": True,
        "canGetAndSetFMUstate": True,
        "canSerializeFMUstate": True,
    }
    exchange = element(root, "ModelExchange", **shared, completedIntegratorStepNotNeeded=True)
    steps = {"canHandleVariableCommunicationStepSize": True, "canInterpolateInputs": True}
    for interface in (exchange, element(root, "CoSimulation", **shared, **steps)):
        files = element(interface, "SourceFiles")
        for name in sorted(name for name in model.sources if name.endswith(".c")):
            element(files, "File", name=name)


def add_units(root: ET.Element, model: Model) -> None:
    """Define the units; units without integer powers of base units are only names."""
    units = element(root, "UnitDefinitions")
    for name, base in model.spec["units"].items():
        unit = element(units, "Unit", name=name)
        if base:
            element(unit, "BaseUnit", **base)


def add_variable(parent: ET.Element, model: Model, reference: int, variable: Variable) -> None:
    """Describe one variable."""
    spec, role = variable.spec, variable.role
    scalar = element(
        parent,
        "ScalarVariable",
        name=variable.name,
        valueReference=reference,
        description=spec.get("description"),
        causality="local" if role in ("state", "derivative") else role,
        variability=spec.get("variability", "fixed" if role == "parameter" else "continuous"),
        initial="exact" if role == "state" else None,
    )
    numbers = {key: spec.get(key) for key in ("unit", "min", "max", "nominal", "start")}
    derivative = model.index(variable.state) if variable.state else None
    element(scalar, "Real", **numbers, derivative=derivative)


def add_structure(root: ET.Element, model: Model) -> None:
    """List outputs and derivatives; all of them are computed, so all are initial unknowns."""
    structure = element(root, "ModelStructure")
    outputs = [model.index(v.name) for v in model.of("output")]
    derivatives = [model.index(v.name) for v in model.of("derivative")]
    sections = {
        "Outputs": outputs,
        "Derivatives": derivatives,
        "InitialUnknowns": sorted(outputs + derivatives),
    }
    for tag, indices in sections.items():
        if not indices:  # without states; the standard forbids an empty list
            continue
        section = element(structure, tag)
        for index in indices:
            element(section, "Unknown", index=index)


def model_description(model: Model) -> bytes:
    """Return ``modelDescription.xml``.

    Parameters
    ----------
    model : Model
        The model to describe.

    Returns
    -------
    bytes
        The document, the same for the same model.
    """
    root = ET.Element("fmiModelDescription", fmiVersion="2.0", modelName=model.name)
    root.set("guid", model.guid)
    root.set("description", model.spec["description"])
    root.set("generationTool", "cluster-est build_fmus")
    root.set("variableNamingConvention", "structured")
    root.set("numberOfEventIndicators", "0")
    add_interfaces(root, model)
    add_units(root, model)
    categories = element(root, "LogCategories")
    element(categories, "Category", name="logStatusError", description="errors")
    experiment = model.spec["experiment"]
    times = {"startTime": 0.0, "stopTime": experiment["stop"], "stepSize": experiment["step"]}
    element(root, "DefaultExperiment", **times)
    variables = element(root, "ModelVariables")
    for reference, variable in enumerate(model.variables):
        add_variable(variables, model, reference, variable)
    add_structure(root, model)
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def compile_library(command: Sequence[str], folder: Path, library: str) -> bytes:
    """Compile the C files of a folder into a shared library and return it."""
    sources = sorted(file.name for file in folder.glob("*.c"))
    link = ["-shared", "-s", "-o", library, *sources, "-lm"]
    # Relative names only, so that the library does not contain the temporary folder.
    subprocess.run([*command, *CFLAGS, f"-I{FMI_HEADERS}", *link], cwd=folder, check=True)
    return (folder / library).read_bytes()


def binary(folder: Path, name: str, compiler: str, platform: str) -> bytes:
    """Compile a model for one platform.

    Parameters
    ----------
    folder : Path
        Holds all sources.
    name : str
        The model's name.
    compiler : {'cc', 'zig'}
        The system's compiler, for the host alone, or zig, for every platform.
    platform : str
        A key of `FMI2_PLATFORMS`.

    Returns
    -------
    bytes
        The shared library.
    """
    library = shared_library(name, platform)
    if compiler == "cc":
        return compile_library(["cc", "-fPIC"], folder, library)
    zig = [sys.executable, "-m", "ziglang", "cc", "-fPIC", "-target"]
    targets = [core_build.PLATFORMS[part] for part in FMI2_PLATFORMS[platform]]
    parts = [compile_library([*zig, target], folder, library) for target in targets]
    return parts[0] if len(parts) == 1 else universal_binary(parts)


def write_archive(path: Path, files: dict[str, bytes]) -> None:
    """Write a zip archive whose bytes depend only on its contents."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(files.items()):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # the same on every system
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)


def build(
    folder: Path,
    out: Path | None = None,
    compiler: str = "cc",
    platforms: Sequence[str] = ("linux64",),
) -> Path:
    """Build the FMU of a model.

    Parameters
    ----------
    folder : Path
        The model's folder.
    out : Path, optional
        Where to put the FMU; beside the model's folder by default.
    compiler : {'cc', 'zig'}
        The system's compiler builds for a 64-bit Linux host only.
    platforms : sequence of str
        The platforms to build for.

    Returns
    -------
    Path
        The archive, named after the folder.
    """
    return build_archive(read_model(folder), out or folder.parent, compiler, platforms)


def build_archive(
    model: Model, out: Path, compiler: str = "cc", platforms: Sequence[str] = ("linux64",)
) -> Path:
    """Build the FMU of a model that may have no folder; see `build`."""
    sources = {**model.sources, "model_variables.h": c_header(model).encode()}
    files = {f"sources/{name}": text for name, text in sources.items()}
    files["modelDescription.xml"] = model_description(model)
    with tempfile.TemporaryDirectory() as build_folder:
        for name, text in sources.items():
            Path(build_folder, name).write_bytes(text)
        for platform in platforms:
            library = binary(Path(build_folder), model.name, compiler, platform)
            files[f"binaries/{platform}/{shared_library(model.name, platform)}"] = library
    path = out / f"{model.name}.fmu"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_archive(path, files)
    return path


def model_folder(name: str) -> Path:
    """Return the folder of an example by its name, or any folder by its path."""
    return MODELS / name if (MODELS / name / "model.toml").exists() else Path(name).resolve()


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Build the example FMUs.")
    parser.add_argument("models", nargs="*", metavar="NAME", help="example or folder; default all")
    parser.add_argument("--out", type=Path, help="folder for the FMUs; default beside the models")
    parser.add_argument("--compiler", choices=["cc", "zig"], default="cc")
    parser.add_argument("--platforms", nargs="+", choices=list(FMI2_PLATFORMS), default=["linux64"])
    options = parser.parse_args(arguments)
    if options.compiler == "cc" and options.platforms != ["linux64"]:
        parser.error("the system's compiler builds for linux64 only; use --compiler zig")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Build the models named on the command line, or all examples."""
    options = parse(arguments)
    examples = sorted(file.parent.name for file in MODELS.glob("*/model.toml"))
    for name in options.models or examples:
        print(build(model_folder(name), options.out, options.compiler, options.platforms))


if __name__ == "__main__":
    main()
