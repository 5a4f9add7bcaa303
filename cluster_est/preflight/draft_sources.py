"""Sources of a first config: files, tests in a file, reference results in an FMU, and folders.

A folder contains the tables of PEtab (Schmiester et al., PLoS Comput Biol 17, 2021,
doi:10.1371/journal.pcbi.1008646): `measurements` with a row for each value, and optionally
`conditions`, `observables` and `parameters`, as .tsv or .csv.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cluster_est.config.reader import read_values
from cluster_est.errors import DataError
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.formats.fmu_references import (
    ReferenceExperiment,
    reference_experiments,
)
from cluster_est.problem.tables.measured_table import MeasuredTable, Reading
from cluster_est.toml import dotted, inline
from workers.messages import Value

ROLES = ("measurements", "conditions", "observables", "parameters")
"""Tables of a folder, each recognised by the beginning of a part of its name."""
ENDINGS = (".tsv", ".csv")


@dataclass(frozen=True)
class DraftSource:
    """A table, or a test in a table, that becomes an experiment.

    Attributes
    ----------
    path
        Path of the file.
    id
        Id of the experiment; "" for the name of the file.
    reading
        Known options for reading the file.
    test
        (column, value) of a test in it; None for the complete file.
    lines
        Lines of the config that follow from its origin.
    """

    path: Path
    id: str = ""
    reading: Reading = field(default_factory=Reading)
    test: tuple[str, str] | None = None
    lines: tuple[str, ...] = ()


@dataclass(frozen=True)
class KnownParameter:
    """A parameter in the tables of a folder.

    Attributes
    ----------
    start, bounds, scale
        For the estimation; bounds are None if they are not given.
    estimate
        Whether it is estimated; otherwise `start` is its value.
    """

    start: float
    bounds: tuple[float, float] | None
    scale: str
    estimate: bool


@dataclass(frozen=True)
class DraftSources:
    """All tables, and other information from their origin.

    Attributes
    ----------
    tables
        Tables in their order.
    mapping
        Columns of variables.
    parameters
        Parameters by name.
    """

    tables: tuple[DraftSource, ...]
    mapping: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, KnownParameter] = field(default_factory=dict)


def sources(fmu: Path, data: Sequence[Path], reading: Reading) -> DraftSources:
    """Find the tables of files and folders, or those in the FMU if none are named.

    Raises
    ------
    DataError
        If there are none, or a folder has no measurements.
    """
    if not data:
        found = tuple(_reference(fmu, each, reading) for each in reference_experiments(fmu))
        if not found:
            raise DataError(
                f"init: {fmu} must contain reference results (FMI-LS-REF) if no table is named, "
                "but contains none; name a table"
            )
        return DraftSources(found)
    folders = [path for path in data if path.is_dir()]
    if folders and len(data) > 1:
        raise DataError(
            f"init: {folders[0]} is a folder of tables, so it must be the only argument besides "
            "the FMU, but others are given; name the files in it instead"
        )
    if folders:
        return _folder(folders[0], reading)
    return DraftSources(tuple(DraftSource(path, reading=reading) for path in data))


def _reference(fmu: Path, each: ReferenceExperiment, reading: Reading) -> DraftSource:
    lines = [
        f"{key} = {inline(number)}"
        for key, number in (("start", each.start), ("stop", each.stop))
        if number is not None
    ]
    if each.parameters:
        with zipfile.ZipFile(fmu) as archive, TemporaryDirectory() as folder:
            copy = Path(folder) / Path(each.parameters).name
            copy.write_bytes(archive.read(each.parameters))
            values = {given.name: given.value for given in read_values(copy)}
        lines += _values(values)
    return DraftSource(fmu, each.name, replace(reading, sheet=each.name), lines=tuple(lines))


def _values(values: Mapping[str, Value]) -> list[str]:
    return [f"{dotted('values', name)} = {inline(value)}" for name, value in values.items()]


def _folder(folder: Path, reading: Reading) -> DraftSources:
    files = {role: _file(folder, role) for role in ROLES}
    measured = files["measurements"]
    if measured is None:
        raise DataError(
            f"init: {folder} must have a table called measurements (.tsv or .csv), but has none; "
            "name the tables themselves"
        )
    long = Reading(long=("observableId", "measurement"))
    table = read_table(measured, "init", reading=replace(reading, long=long.long))
    ids = table.tests("simulationConditionId", "init")
    conditions, observables, parameters = (
        None if (path := files[role]) is None else read_table(path, "init") for role in ROLES[1:]
    )
    rows = {row["conditionId"]: row for row in _rows(conditions)}
    sigmas, mapping = _observed(_rows(observables))
    found = []
    for name in ids:
        own = rows.get(name, {})
        values = {k: v for k, v in own.items() if k not in ("conditionId", "conditionName")}
        lines = (*_values({k: _value(v) for k, v in values.items() if v}), *sigmas)
        test = ("simulationConditionId", name)
        found.append(DraftSource(measured, name, table.reading, test, lines))
    known = {name: each for name, each in map(_parameter, _rows(parameters)) if name}
    return DraftSources(tuple(found), mapping, known)


def _file(folder: Path, role: str) -> Path | None:
    """Return the table of a folder with a role."""
    found = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in ENDINGS and role.rstrip("s") in path.stem.lower()
    ]
    if len(found) > 1:
        raise DataError(
            f"init: {folder} must have one table of {role}, but has {found[0].name} and "
            f"{found[1].name}; move one of the two to another folder"
        )
    return found[0] if found else None


def _rows(table: MeasuredTable | None) -> Iterator[dict[str, str]]:
    """Yield the rows of a small table as texts."""
    if table is None:
        return
    columns = {
        name: [_text(cell) for cell in (c.tolist() if isinstance(c, np.ndarray) else c.to_pylist())]
        for name, c in table.columns.items()
    }
    for i in range(max(map(len, columns.values()), default=0)):
        yield {name: cells[i] for name, cells in columns.items()}


def _text(cell: Any) -> str:
    missing = cell is None or (isinstance(cell, float) and np.isnan(cell))
    return "" if missing else str(cell).strip()


def _value(text: str) -> Value:
    try:
        return float(text)
    except ValueError:
        return text


def _observed(rows: Iterator[dict[str, str]]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return lines with the noise of outputs, and the column of each variable."""
    lines, mapping = [], {}
    for row in rows:
        variable = row.get("observableFormula") or row["observableId"]
        mapping[variable] = row["observableId"]
        noise = _value(row.get("noiseFormula", ""))
        if isinstance(noise, float):
            lines.append(f"{dotted('sigma', variable)} = {inline(noise)}")
    return tuple(lines), mapping


def _parameter(row: dict[str, str]) -> tuple[str, KnownParameter]:
    ends = _value(row.get("lowerBound", "")), _value(row.get("upperBound", ""))
    low, high = ends
    bounds = (low, high) if isinstance(low, float) and isinstance(high, float) else None
    start = _value(row.get("nominalValue", ""))
    if not isinstance(start, float):
        raise DataError(
            f"init: parameters: {row.get('parameterId')} must have a nominalValue, but has none; "
            "add it"
        )
    scale = "log" if row.get("parameterScale", "lin").startswith("log") else "linear"
    estimate = row.get("estimate", "1") not in ("0", "0.0", "false", "False")
    return row.get("parameterId", ""), KnownParameter(start, bounds, scale, estimate)
