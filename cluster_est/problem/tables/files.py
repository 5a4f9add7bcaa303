"""Reads measured tables from files; the file name's extension determines the format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats import ENDINGS, TableFormat
from cluster_est.problem.tables.long_tables import wide
from cluster_est.problem.tables.measured_table import MeasuredTable, Reading
from workers.fmu.description import nearest
from workers.messages.checks import as_path, as_tuple, check_kind, check_number

INSTEAD = {
    ".zip": "unpack it", ".7z": "unpack it", ".xls": "save it as .xlsx",
    ".ods": "save it as .xlsx", ".json": "save it as .csv", ".jsonl": "save it as .csv",
    ".blf": "save it as .mf4", ".d97": "save it as .mf4", ".raw": "save it as .csv or .mf4",
}  # fmt: skip
"""How to convert files in other formats to a readable file, by extension."""
OF_EVERY_FORMAT = ("time_format", "time_zone", "long")
"""Keys of `Reading` that apply to all formats."""


def format_of(path: Path) -> TableFormat | None:
    """Return the format for the extension of a file name; None if it is unknown."""
    name = path.name.lower()
    return ENDINGS.get("".join(Path(name).suffixes[-2:])) or ENDINGS.get(Path(name).suffix)


def read_table(
    path: str | Path,
    where: str = "table",
    *,
    reading: Reading | Mapping[str, Any] | None = None,
) -> MeasuredTable:
    """Read a measured file; its extension determines the format.

    Parameters
    ----------
    path
        Path of a file in one of the formats, such as csv, parquet, MAT, MDF or xlsx.
    where
        Start of each message.
    reading
        Options for reading the file, with the keys of a config, such as {"encoding": "cp1252"}.

    Raises
    ------
    DataError
        If there is no such file, its content does not fit its extension, or the library for its
        format is not installed.
    """
    path = as_path(path, where, DataError)
    reading = _checked(reading, where)
    kind = format_of(path)
    if kind is None:
        raise DataError(
            f"{where}: {path} must end in one of {', '.join(ENDINGS)}, but ends in "
            f"{path.suffix!r}; {INSTEAD.get(path.suffix.lower(), 'convert the file or rename it')}"
        )
    _refuse_idle(kind, reading, path, where)
    try:
        path.stat()  # before the import of a library that may be missing
        table = replace(kind.read(path, reading), reading=reading)
        return wide(table, *reading.long) if reading.long else table
    except DataError as error:
        raise DataError(f"{where}: {path} {error}") from None
    except FileNotFoundError:
        raise DataError(f"{where}: there is no file {path}; check the path") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"{where}: {path} must be a readable {kind.name} file, but is not ({reason}); check "
            "that it is complete, or save it again"
        ) from error


def _checked(given: Reading | Mapping[str, Any] | None, where: str) -> Reading:
    if isinstance(given, Reading):
        return given
    check_kind({} if given is None else given, Mapping, f"{where}.reading", DataError)
    values, known = dict(given or {}), [each.name for each in fields(Reading)]
    for key, value in values.items():
        if key not in known:
            raise DataError(f"{where}.reading: unknown key {key}{nearest(str(key), known)}")
        at = f"{where}.reading.{key}"
        if key == "skip_rows":
            check_number(value, at, DataError, least=0, whole=True)
        elif key == "long":
            values[key] = as_tuple(value, str, at, DataError)
            if len(values[key]) != 2:
                raise DataError(
                    f"{at}: must be the names of two columns, (names, values), but is {value!r}"
                )
        else:
            check_kind(value, str, at, DataError)
    if values.get("decimal", "") not in ("", ".", ","):
        raise DataError(
            f'{where}.reading.decimal: must be "." or ",", but is {values["decimal"]!r}'
        )
    return Reading(**values)


def _refuse_idle(kind: TableFormat, reading: Reading, path: Path, where: str) -> None:
    """Refuse options that have no effect on this format, because the user expects an effect."""
    known, usual = (*kind.keys, *OF_EVERY_FORMAT), Reading()
    for key in vars(reading):
        if key not in known and getattr(reading, key) != getattr(usual, key):
            raise DataError(
                f"{where}.{key}: has no meaning for {path}, whose format is {kind.name}; remove it"
            )
