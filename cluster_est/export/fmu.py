"""The exported FMU: wrapper, original and description in one archive."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from importlib.resources import files
from pathlib import Path

from cluster_est.errors import RunFolderError
from cluster_est.export.c_code import effects_source
from cluster_est.export.compiler import compile_library, find_compiler
from cluster_est.export.description import identifier, model_description
from cluster_est.export.header import header
from cluster_est.export.layout import WrapperLayout, lay_out
from cluster_est.export.repair import RepairedModel
from cluster_est.export.text import describe_effects
from cluster_est.run_folder.run_identity import versions
from workers.fmu.archive import open_archive
from workers.fmu.platforms import binary_path

_README = """# {name}

{file} with the estimates and effects of run {run}, made by {tool}.

The original FMU lies unpacked in resources/original; the library in binaries/ loads it from there.
The wrapper's C sources are in sources/. They need no further header and are compiled with

    cc -std=c99 -O2 -ffp-contract=off -fPIC -shared -o {name}.so *.c -lm -ldl

{simulation}

{effects}"""
_EXCHANGE = """In co-simulation the wrapper integrates the repaired model with {solver}. In model
exchange delays and backlashes are sampled at completed integrator steps."""
_SIMULATION = """The original is for co-simulation, so this FMU is too; it makes the steps of the
run."""

_MOST_NAMED = 8


def write_fmu(repair: RepairedModel, path: Path) -> tuple[str, ...]:
    """Write the repaired FMU and return sentences on what a user should know of it.

    Raises
    ------
    ModelError
        If the original cannot be wrapped, or no compiler is there or it fails.
    RunFolderError
        If the file cannot be written.
    """
    layout = lay_out(repair)
    command = find_compiler()
    repair.description.check_platform(repair.problem.model.interface)
    content = archive_files(layout, command)
    partial = path.with_name(f".{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_archive(partial, content)
        partial.replace(path)
    except OSError as error:
        raise RunFolderError(
            f"--fmu: {path} cannot be written ({error}); choose another"
        ) from error
    return _notes(layout)


def archive_files(layout: WrapperLayout, command: tuple[str, ...]) -> dict[str, bytes]:
    """Everything in the archive by its name; the same for the same run, sources and compiler."""
    name, model = identifier(layout), layout.repair.problem.model
    sources = wrapper_sources() | {"effects.c": effects_source(layout).encode()}
    tool = f"cluster-est {versions()['cluster-est']}"
    names = tuple(sorted(source for source in sources if source.endswith(".c")))
    digest = hashlib.sha256(model.archive_hash.encode())
    unnamed = {**sources, "model.h": header(layout, "").encode()}
    unnamed["xml"] = model_description(layout, "", names, tool)
    for file, text in sorted(unnamed.items()):
        digest.update(file.encode() + b"\0" + text)
    guid = "{" + digest.hexdigest()[:32] + "}"
    sources["model.h"] = header(layout, guid).encode()
    found = {f"sources/{file}": text for file, text in sources.items()}
    found["modelDescription.xml"] = model_description(layout, guid, names, tool)
    found["documentation/README.md"] = _readme(layout, name, tool).encode()
    library = binary_path("2.0", name)
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            Path(folder, file).write_bytes(text)
        found[library] = compile_library(command, Path(folder), os.path.basename(library))
    with open_archive(model.name, model.archive) as opened:
        for entry in opened.infolist():  # empty folders too: some originals look for theirs
            found[f"resources/original/{entry.filename}"] = opened.read(entry)
    return found


def wrapper_sources() -> dict[str, bytes]:
    """The C files that are the same for every model."""
    folder = files("cluster_est.export") / "c"
    found = {file.name: file.read_bytes() for file in folder.iterdir()}
    return {name: text for name, text in sorted(found.items()) if name.endswith((".c", ".h"))}


def _readme(layout: WrapperLayout, name: str, tool: str) -> str:
    model = layout.repair.problem.model
    solver = "dormand_prince" if model.solver.name == "cvode" else model.solver.name
    how = _EXCHANGE.format(solver=solver) if layout.exchange else _SIMULATION
    return _README.format(
        name=name, file=model.name, run=layout.repair.run, tool=tool, simulation=how,
        effects=describe_effects(layout.repair),
    )  # fmt: skip


def _notes(layout: WrapperLayout) -> tuple[str, ...]:
    notes = []
    if layout.repair.problem.model.solver.name == "cvode":
        notes.append(
            "in co-simulation the exported FMU integrates with dormand_prince where the run used "
            "cvode, which is slow if the model is stiff; in model exchange the importer's solver "
            "integrates"
        )
    if layout.signals:
        one = len(layout.signals) == 1
        notes.append(
            f"{', '.join(layout.signals)} {'is an input' if one else 'are inputs'} of the exported "
            "FMU, because effects depend on what was measured there"
        )
    if layout.left_out:
        more = len(layout.left_out) - _MOST_NAMED
        notes.append(
            f"the exported FMU is without {', '.join(layout.left_out[:_MOST_NAMED])}"
            f"{f' and {more} more' if more > 0 else ''}, which FMI 2.0 cannot say; they keep the "
            "values that the original has"
        )
    return tuple(notes)


def _write_archive(path: Path, content: dict[str, bytes]) -> None:
    """Write a zip archive that depends on its contents only."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in sorted(content.items()):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # the same archive, whatever system builds it
            runnable = entry.is_dir() or "binaries/" in name
            entry.external_attr = 0o755 << 16 if runnable else 0o644 << 16
            archive.writestr(entry, data)
