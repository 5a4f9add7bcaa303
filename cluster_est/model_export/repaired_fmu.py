"""The exported FMU: wrapper, original and description in one archive."""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from cluster_est.errors import ModelError
from cluster_est.model_export.c_code import effects_source, header
from cluster_est.model_export.compiler import (
    PLATFORMS,
    check_cross_compiler,
    compile_for,
    compile_library,
    find_compiler,
)
from cluster_est.model_export.fmi2_description import identifier, model_description, with_step
from cluster_est.model_export.repaired_model import RepairedModel, describe_repair
from cluster_est.model_export.step_error import StepErrors, measure_step
from cluster_est.model_export.wrapper_layout import WrapperLayout, lay_out
from cluster_est.run_folder.run_identity import versions
from cluster_est.whole_files import ELSEWHERE, write_whole, writing
from workers.fmu.archive import open_archive
from workers.fmu.platforms import PLATFORM, binary_path, platforms_in
from workers.fmu.xml import XML

_README = """# {name}

{file} with the estimates and effects of run {run}, made by {tool}.

## What was added

{effects}
## The data

{data}

## The error before and after

{errors}

## The communication step

{step}

## How it works

The original FMU lies unpacked in resources/original; the library in binaries/ loads it from there.
{simulation}

The wrapper's C sources are in sources/. They need no further header and are compiled with

    cc -std=c99 -O2 -ffp-contract=off -fPIC -shared -o {name}.so *.c -lm -ldl
"""
_EXCHANGE = """In co-simulation the wrapper integrates the repaired model with {solver}. In model
exchange the tool integrates: the run had a relative tolerance of {tolerance:g}, which is the FMU's
default too, and a looser one, or an output interval that inputs change within, adds an error of its
own. Delays and backlashes are sampled at completed integrator steps."""
_SIMULATION = """The original is for co-simulation, so this FMU is too; it makes the steps of the
run."""
_STEP = """In co-simulation, {sentence}.

The run took inputs as linear between their samples, or held, as its config says. Here they were
kept constant within each communication step, as most tools do, and every experiment had its own
values. Tools that set input derivatives (fmi2SetRealInputDerivatives) may take longer steps."""


def readme(layout: WrapperLayout, name: str, tool: str, step: StepErrors | None) -> str:
    """The text in Markdown.

    Parameters
    ----------
    layout
        The exported FMU.
    name, tool
        Of its library, and what made it.
    step
        What was measured of its communication step; None if that was not wanted.
    """
    repair = layout.repair
    model = repair.problem.model
    solver = "dormand_prince" if model.solver.name == "cvode" else model.solver.name
    how = (
        _EXCHANGE.format(solver=solver, tolerance=layout.tolerance)
        if layout.exchange
        else _SIMULATION
    )
    return _README.format(
        name=name,
        file=model.name,
        run=repair.run,
        tool=tool,
        effects="\n".join(f"    {line}".rstrip() for line in describe_repair(repair).split("\n")),
        data=_data(repair),
        errors=_errors(repair),
        step="It was not measured." if step is None else _step(step),
        simulation=how,
    )


def _data(repair: RepairedModel) -> str:
    lines = ["| experiment | role | from | to | outputs |", "|---|---|---|---|---|"]
    for experiment in repair.problem.experiments:
        role = "fitted" if experiment.role == "train" else "held out"
        outputs = ", ".join(
            f"{_cell(output.variable)} ({len(output.times)} samples)"
            for output in experiment.outputs
        )
        times = f"{experiment.start:.6g} s | {experiment.stop:.6g} s"
        lines.append(f"| {_cell(experiment.id)} | {role} | {times} | {outputs} |")
    return "\n".join(lines)


def _errors(repair: RepairedModel) -> str:
    if not repair.errors:
        return "Nothing was reported."
    lines = [
        f"Root mean square errors; before: {repair.without}; after: with all that is in this FMU.",
        "",
        "| experiment | role | output | unit | before | after |",
        "|---|---|---|---|---|---|",
    ]
    for error in repair.errors:
        role = "fitted" if error.role == "train" else "held out"
        sizes = f"{error.before:.4g} | {error.after:.4g}"
        named = f"{_cell(error.experiment)} | {role} | {_cell(error.output)} | {error.unit}"
        lines.append(f"| {named} | {sizes} |")
    return "\n".join(lines)


def _step(found: StepErrors) -> str:
    if found.why_not:
        return f"It was not measured, because {found.why_not}."
    names = [name for name, _ in found.reported]
    units = dict(found.units)
    heads = [f"RMSE of {_cell(n)}{f' ({units[n]})' if units.get(n) else ''}" for n in names]
    lines = [f"| step | {' | '.join(heads)} |", "|---" * (len(names) + 1) + "|"]
    rows = [(f"{step:.6g} s", dict(errors)) for step, errors in found.measured]
    rows.append(("the run", dict(found.reported)))
    lines += [f"| {head} | {' | '.join(f'{of[n]:.4g}' for n in names)} |" for head, of in rows]
    of = ", ".join(found.experiments)
    table = "\n".join([f"Over experiments {of}:", "", *lines])
    return f"{_STEP.format(sentence=found.sentence)}\n\n{table}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


_MOST_NAMED = 8


@dataclass(frozen=True)
class FmuOptions:
    """What goes into an exported FMU.

    Attributes
    ----------
    platforms
        Platforms that it is compiled for besides this machine's, by FMI 2.0's names.
    measure
        Whether the communication step is measured that reproduces the error of the run.
    """

    platforms: tuple[str, ...] = ()
    measure: bool = True


def write_fmu(
    repair: RepairedModel, path: Path, options: FmuOptions | None = None
) -> tuple[str, ...]:
    """Write the repaired FMU and return sentences on what a user should know of it.

    Raises
    ------
    ModelError
        If the original cannot be wrapped, or no compiler is there or it fails.
    RunFolderError
        If the file cannot be written.
    """
    options = options or FmuOptions()
    others = tuple(p for p in dict.fromkeys(options.platforms) if p != PLATFORM)
    layout = lay_out(repair)
    command = find_compiler()
    check_cross_compiler(others)
    repair.description.check_platform(repair.problem.model.interface)
    _check_platforms(repair, others)
    content = archive_files(layout, command, others)
    _write(path, content)
    if not options.measure or not repair.errors:
        return _notes(layout)
    step = measure_step(repair, _archive(content))  # a crash of the FMU would leave what is written
    content |= _about(layout, step)
    if step.reproduces is not None:
        content[XML] = with_step(content[XML], step.reproduces)
    _write(path, content)
    return (*_notes(layout), step.sentence)


def _write(path: Path, content: dict[str, bytes]) -> None:
    """Write the archive in one step."""
    advice = f"{ELSEWHERE} --fmu"
    with writing(path, advice):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _archive(content), advice, shared=True)


def _check_platforms(repair: RepairedModel, platforms: Sequence[str]) -> None:
    """Refuse platforms that the original has no binary for: the wrapper loads that."""
    model = repair.problem.model
    with open_archive(model.name, model.archive) as opened:
        there = platforms_in(opened.namelist())
    for platform in platforms:
        names = (platform,) if repair.description.version == "2.0" else PLATFORMS[platform].tuples
        if not set(names) & set(there):
            raise ModelError(
                f"--platforms: {model.name} must have a binary for {platform}, which the exported "
                f"FMU loads, but has one for {', '.join(there)}; export it for {platform} too, or "
                "leave that out"
            )


def archive_files(
    layout: WrapperLayout, command: tuple[str, ...], platforms: Sequence[str] = ()
) -> dict[str, bytes]:
    """Everything in the archive by its name; the same for the same run, sources and compiler."""
    name, model = identifier(layout), layout.repair.problem.model
    sources = wrapper_sources() | {"effects.c": effects_source(layout).encode()}
    tool = _tool()
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
    found |= _about(layout, None)
    library = binary_path("2.0", name)
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            Path(folder, file).write_bytes(text)
        found[library] = compile_library(command, Path(folder), os.path.basename(library))
        for platform in platforms:
            path = f"binaries/{platform}/{name}{PLATFORMS[platform].suffix}"
            found[path] = compile_for(platform, Path(folder), name)
    with open_archive(model.name, model.archive) as opened:
        for entry in opened.infolist():  # empty folders too: some originals look for theirs
            found[f"resources/original/{entry.filename}"] = opened.read(entry)
    return found


def _tool() -> str:
    return f"cluster-est {versions()['cluster-est']}"


def _about(layout: WrapperLayout, step: StepErrors | None) -> dict[str, bytes]:
    """What a person reads, by its name in the archive."""
    text = readme(layout, identifier(layout), _tool(), step)
    return {"documentation/README.md": text.encode()}


def wrapper_sources() -> dict[str, bytes]:
    """The C files that are the same for every model."""
    folder = files("cluster_est.model_export") / "c"
    found = {file.name: file.read_bytes() for file in folder.iterdir()}
    return {name: text for name, text in sorted(found.items()) if name.endswith((".c", ".h"))}


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


def _archive(content: dict[str, bytes]) -> bytes:
    """Return a zip archive that depends on its contents only."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in sorted(content.items()):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # the same archive, whatever system builds it
            runnable = entry.is_dir() or "binaries/" in name
            entry.external_attr = 0o755 << 16 if runnable else 0o644 << 16
            archive.writestr(entry, data)
    return target.getvalue()
