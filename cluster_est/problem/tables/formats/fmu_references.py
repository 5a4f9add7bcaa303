"""Reads the reference results in the archive of an FMU, according to FMI-LS-REF.

The manifest `extra/org.fmi-standard.fmi-ls-ref/fmi-ls-manifest.xml` lists files with their roles. A
file with the role `experiment` lists experiments (MA-HS-Experiments). Each has start and stop times
and files of parameters, stimuli and references, which are CSV tables with a time column.
FMI-LS-REF 1.0.0-alpha.1 (Modelica Association, 2025), https://github.com/modelica/fmi-ls-ref.
"""

from __future__ import annotations

import posixpath
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar, Final
from xml.etree import ElementTree

from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats.delimited import DelimitedText
from cluster_est.problem.tables.formats.table_format import TableFormat
from cluster_est.problem.tables.measured_table import Column, MeasuredTable, Reading
from cluster_est.toml import inline
from workers.fmu.description import nearest

FOLDER: Final = "extra/org.fmi-standard.fmi-ls-ref"
MANIFEST: Final = f"{FOLDER}/fmi-ls-manifest.xml"
MOST_BYTES: Final = 2**31
"""Largest size of an unpacked file of the archive in bytes."""


@dataclass(frozen=True)
class ReferenceExperiment:
    """An experiment in the archive of an FMU.

    Attributes
    ----------
    name
        Name of the experiment.
    references, stimuli, parameters
        Files of the archive; empty if there is none.
    start, stop
        Start and stop times in seconds; None if they are not given.
    """

    name: str
    references: str
    stimuli: str = ""
    parameters: str = ""
    start: float | None = None
    stop: float | None = None


class FmuReferences(TableFormat):
    """Experiments in the archive of an FMU; `sheet` selects one of several."""

    name: ClassVar[str] = "FMU"
    endings: ClassVar[tuple[str, ...]] = (".fmu",)
    keys: ClassVar[tuple[str, ...]] = ("sheet",)

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        found = {each.name: each for each in reference_experiments(path)}
        if not found:
            raise DataError(
                f"must have reference results ({MANIFEST} and a file with the role experiment), "
                "but has none; name a table instead"
            )
        names = ", ".join(map(repr, found))
        if not reading.sheet and len(found) > 1:
            first = inline(next(iter(found)))
            raise DataError(f"has several experiments: {names}; choose one, as in sheet = {first}")
        if reading.sheet and reading.sheet not in found:
            hint = nearest(reading.sheet, [*found])
            raise DataError(f"has no experiment {reading.sheet!r}{hint}")
        return _read(path, found[reading.sheet or next(iter(found))])


def reference_experiments(path: Path) -> tuple[ReferenceExperiment, ...]:
    """Return the experiments with reference results in an FMU.

    Raises
    ------
    DataError
        If the file is not an archive, or the manifest or a list of experiments is damaged or names
        a missing file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return tuple(_experiments(archive))
    except (zipfile.BadZipFile, ElementTree.ParseError, KeyError) as error:
        raise DataError(
            f"must be an FMU, but cannot be read as one ({error}); check the file"
        ) from error


def _experiments(archive: zipfile.ZipFile) -> Iterator[ReferenceExperiment]:
    names = set(archive.namelist())
    if MANIFEST not in names:
        return
    for related in _tree(archive, MANIFEST):
        if _bare(related.tag) != "Related" or not related.get("role", "").startswith("experiment"):
            continue
        file = posixpath.normpath(posixpath.join(FOLDER, related.get("source", "")))
        if file not in names:  # allowed by FMI-LS-REF, section "Related Files"
            continue
        for each in _tree(archive, file):
            found = {_bare(part.tag): part.get("source", "") for part in each}
            if _bare(each.tag) != "Experiment" or not found.get("References"):
                continue
            files = {role: _inside(source, file, names) for role, source in found.items() if source}
            yield ReferenceExperiment(
                each.get("name") or f"experiment {file}",
                files["References"],
                files.get("Stimuli", ""),
                files.get("Parameters", ""),
                _seconds(each.get("startTime")),
                _seconds(each.get("stopTime")),
            )


def _tree(archive: zipfile.ZipFile, name: str) -> ElementTree.Element:
    if archive.getinfo(name).file_size > MOST_BYTES:
        raise DataError(f"must have a small file {name}, but {name} is too large; check the FMU")
    content = archive.read(name)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise DataError(f"must have no document type declaration in {name}, but has one; remove it")
    return ElementTree.fromstring(content)


def _bare(tag: str) -> str:
    """Return a tag without its namespace."""
    return tag.rpartition("}")[2]


def _inside(source: str, beside: str, names: set[str]) -> str:
    """Return the file for a path, relative to the file that names it or to the archive."""
    for base in (posixpath.dirname(beside), ""):
        found = posixpath.normpath(posixpath.join(base, source))
        if found in names:
            return found
    raise DataError(
        f"{beside} refers to the file {source}, but there is no such file; check the FMU"
    )


def _seconds(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        raise DataError(
            f"must have numbers as startTime and stopTime, but has {text!r}; correct them"
        ) from None


def _read(path: Path, experiment: ReferenceExperiment) -> MeasuredTable:
    """Return the columns of references and stimuli, with the times of their files."""
    columns: dict[str, Column] = {}
    unusable: dict[str, str] = {}
    units: dict[str, str] = {}
    clocks: dict[str, str] = {}
    notes: list[str] = [f"experiment {experiment.name!r} of the FMU's reference results is read"]
    for role, file in (("references", experiment.references), ("stimuli", experiment.stimuli)):
        if not file:
            continue
        table = _table(path, file)
        first = next(iter(table.columns), "")
        clock = first if role == "references" else f"{first} of stimuli"
        for name, column in table.columns.items():
            own = clock if name == first else name
            if own in columns:
                continue  # a reference result may repeat a stimulus
            columns[own] = column
            clocks[own] = clock
        unusable |= table.unusable
        units |= table.units
        notes += [f"{file}: {note}" for note in table.notes]
    clocks = {name: clock for name, clock in clocks.items() if name != clock}
    return MeasuredTable(path, columns, unusable, units=units, clocks=clocks, notes=tuple(notes))


def _table(path: Path, file: str) -> MeasuredTable:
    if not file.lower().endswith(DelimitedText.endings):
        raise DataError(f"must have reference results as CSV, but has {file}; convert it")
    with zipfile.ZipFile(path) as archive, TemporaryDirectory() as folder:
        if archive.getinfo(file).file_size > MOST_BYTES:
            raise DataError(
                f"must have reference results of at most 2 GB, but {file} is larger; shorten it"
            )
        copy = Path(folder) / "table.csv"
        copy.write_bytes(archive.read(file))
        return DelimitedText().read(copy, Reading())
