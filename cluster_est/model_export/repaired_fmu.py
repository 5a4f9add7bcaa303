"""The exported FMU: wrapper, original and model description in one archive."""

from __future__ import annotations

import hashlib
import io
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from cluster_est.model_export.fmi2_description import identifier, model_description, with_step
from cluster_est.model_export.repaired_model import RepairedModel, describe_repair
from cluster_est.model_export.step_error import StepErrors, measure_step
from cluster_est.model_export.wrapper_binaries import (
    FMI2_PLATFORMS,
    wrapper_binary,
    wrapper_platforms,
)
from cluster_est.model_export.wrapper_layout import WrapperLayout, lay_out
from cluster_est.model_export.wrapper_table import wrapper_table
from cluster_est.run_folder.run_identity import versions
from cluster_est.whole_files import ELSEWHERE, write_whole, writing
from workers.fmu.archive import open_archive
from workers.fmu.platforms import PLATFORM, PLATFORM_TUPLE, platforms_in, shared_library
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

The original FMU is unpacked in resources/original; the library in binaries/ loads it from there.
{simulation}

The file resources/repaired.bin has the effects as byte code, and other data that the library needs.
The library is the same in every FMU that this version of cluster-est exports. Its licence is in
documentation/licenses, and must be distributed with it.
"""
_EXCHANGE = """In co-simulation, the wrapper integrates the repaired model with {solver}. In model
exchange, the importing tool integrates. The run had a relative tolerance of {tolerance:g}, which is
also the default of this FMU. A looser tolerance adds an error, and so does an output interval
within which inputs change. Delays and backlash are sampled at completed integrator steps."""
_SIMULATION = """The original FMU is for co-simulation, and so is this one. It makes the steps of
the run."""
_STEP = """In co-simulation, {sentence}.

These errors were computed with inputs that are constant within each communication step, as in most
tools. In the run, inputs were interpolated linearly or held between their samples, as set in the
config of the run. Parameters that differ between experiments had the values of each experiment.
Tools that set input derivatives (fmi2SetRealInputDerivatives) may take longer steps."""


def readme(layout: WrapperLayout, name: str, tool: str, step: StepErrors | None) -> str:
    """Return the documentation in Markdown.

    Parameters
    ----------
    layout
        Layout of the exported FMU.
    name, tool
        Name of its library, and the tool that made it.
    step
        Errors at communication steps; None if not measured.
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
        step="The error at different communication steps was not measured."
        if step is None
        else _step(step),
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
        return "The run reported no errors."
    lines = [
        f"Root mean square errors; before: {repair.without}; after: with everything in this FMU.",
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
        return (
            f"The error at different communication steps was not measured, because {found.why_not}."
        )
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
TABLE = "resources/repaired.bin"
"""File in the archive with the data of the wrapper."""


def write_fmu(repair: RepairedModel, path: Path, *, measure: bool = True) -> tuple[str, ...]:
    """Write the repaired FMU, and return sentences that a user should know about it.

    Parameters
    ----------
    repair, path
        The repaired model, and the path of the file.
    measure
        Whether to find the communication step that reproduces the error of the run.

    Raises
    ------
    ModelError
        If the original cannot be wrapped, or there is no wrapper for this machine.
    RunFolderError
        If the file cannot be written.
    """
    layout = lay_out(repair)
    repair.description.check_platform(repair.problem.model.interface)
    content = archive_files(layout)
    _write(path, content)
    notes = _notes(layout)
    if not measure or not repair.errors:
        return notes
    step = measure_step(repair, _archive(content))  # a crash leaves the file
    content |= _about(layout, step)
    if step.reproduces is not None:
        content[XML] = with_step(content[XML], step.reproduces)
    _write(path, content)
    return (*notes, step.sentence)


def _write(path: Path, content: dict[str, bytes]) -> None:
    """Write the archive atomically."""
    advice = f"{ELSEWHERE} --fmu"
    with writing(path, advice):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _archive(content), advice, shared=True)


def _original_platforms(layout: WrapperLayout) -> tuple[str, ...]:
    """Return the platforms of the original's binaries, in the names of FMI 2.0."""
    model = layout.repair.problem.model
    with open_archive(model.name, model.archive) as opened:
        there = set(platforms_in(opened.namelist()))
    if layout.repair.description.version == "2.0":
        return tuple(sorted(there))
    named = {PLATFORM: (PLATFORM_TUPLE,), **FMI2_PLATFORMS}
    return tuple(platform for platform, tuples in named.items() if there & set(tuples))


def archive_files(layout: WrapperLayout) -> dict[str, bytes]:
    """Return all files of the archive by name; the same for the same run and wrapper."""
    name, model = identifier(layout), layout.repair.problem.model
    tool = _tool()
    digest = hashlib.sha256(model.archive_hash.encode())
    digest.update(wrapper_table(layout, "") + model_description(layout, "", tool))
    guid = "{" + digest.hexdigest()[:32] + "}"
    found = {TABLE: wrapper_table(layout, guid), XML: model_description(layout, guid, tool)}
    found |= _about(layout, None)
    platforms = _original_platforms(layout)
    for platform in wrapper_platforms():
        if platform in platforms:
            path = f"binaries/{platform}/{shared_library(name, platform)}"
            found[path] = wrapper_binary(platform)
    with open_archive(model.name, model.archive) as opened:
        for entry in opened.infolist():  # including empty folders, which some originals need
            found[f"resources/original/{entry.filename}"] = opened.read(entry)
    return found


def _tool() -> str:
    return f"cluster-est {versions()['cluster-est']}"


def _about(layout: WrapperLayout, step: StepErrors | None) -> dict[str, bytes]:
    """Return the documentation files by their names in the archive."""
    found = {"documentation/README.md": readme(layout, identifier(layout), _tool(), step).encode()}
    try:
        licence = distribution("cluster-est").read_text("licenses/LICENSE")
    except PackageNotFoundError:  # a source tree that is not installed
        licence = None
    if licence:
        found["documentation/licenses/cluster-est.txt"] = licence.encode()
    return found


def _notes(layout: WrapperLayout) -> tuple[str, ...]:
    notes = []
    if layout.repair.problem.model.solver.name == "cvode":
        notes.append(
            "in co-simulation, the exported FMU integrates with dormand_prince and not, as the run "
            "did, with cvode; this is slow if the model is stiff; in model exchange, the importing "
            "tool integrates"
        )
    there = wrapper_platforms()
    absent = [p for p in _original_platforms(layout) if p in FMI2_PLATFORMS and p not in there]
    if absent:
        notes.append(
            f"the exported FMU does not run on {' and '.join(absent)}, although the original does, "
            "because this installation of cluster-est has no library for it; a wheel has libraries "
            "for all platforms"
        )
    if layout.signals:
        one = len(layout.signals) == 1
        notes.append(
            f"{', '.join(layout.signals)} {'is an input' if one else 'are inputs'} of the exported "
            "FMU, because effects depend on "
            f"{'this measured signal' if one else 'these measured signals'}"
        )
    if layout.left_out:
        more = len(layout.left_out) - _MOST_NAMED
        notes.append(
            "the exported FMU does not show "
            f"{', '.join(layout.left_out[:_MOST_NAMED])}{f' and {more} more' if more > 0 else ''}, "
            "because FMI 2.0 cannot describe such variables; they keep the values of the original"
        )
    return tuple(notes)


def _archive(content: dict[str, bytes]) -> bytes:
    """Return a zip archive whose bytes depend only on its contents."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in sorted(content.items()):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # the same on every system
            runnable = entry.is_dir() or "binaries/" in name
            entry.external_attr = 0o755 << 16 if runnable else 0o644 << 16
            archive.writestr(entry, data)
    return target.getvalue()
