"""Measured tables: CSV, Parquet, Feather and MAT, as columns of numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.feather
import pyarrow.parquet

from cluster_est.errors import DataError
from workers.description import nearest
from workers.messages import FloatArray

READERS = {
    ".csv": "csv", ".tsv": "csv", ".txt": "csv",
    ".parquet": "parquet", ".pq": "parquet",
    ".feather": "feather", ".arrow": "feather", ".ipc": "feather",
    ".mat": "mat",
}  # fmt: skip
MISSING = ["", "NaN", "nan", "NAN", "NA", "N/A", "null", "None"]


@dataclass(frozen=True)
class Table:
    """A measured file, its columns still as they are in the file.

    Attributes
    ----------
    path
        Where it came from, for messages.
    columns
        Arrow arrays or NumPy arrays by name.
    first_row
        Line or row number of the first row, as an editor would show it, for messages.
    """

    path: Path
    columns: dict[str, pa.ChunkedArray | FloatArray] = field(repr=False)
    first_row: int

    def numbers(self, name: str, where: str) -> FloatArray:
        """A column as floats, NaN where nothing was measured.

        Raises
        ------
        DataError
            If there is no such column, or if something in it is not a number.
        """
        if name not in self.columns:
            raise DataError(
                f"{where}: {self.path} has no column {name!r}{nearest(name, self.columns)}"
            )
        column = self.columns[name]
        if isinstance(column, np.ndarray):
            return column
        try:
            return _floats(column)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError):
            raise DataError(self._not_a_number(name, column, where)) from None

    def _not_a_number(self, name: str, column: pa.ChunkedArray, where: str) -> str:
        for row, value in enumerate(column):
            try:
                _floats(pa.chunked_array([[value.as_py()]]))
            except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError):
                return (
                    f"{where}: {self.path}, column {name!r}, row {row + self.first_row}: must be "
                    f"a number but is {value.as_py()!r}; mend it, or leave it empty where nothing "
                    "was measured"
                )
        return f"{where}: {self.path}, column {name!r}: must hold numbers but holds {column.type}"


def read_table(path: Path, where: str) -> Table:
    """Read a measured file; its ending says what it is.

    Raises
    ------
    DataError
        If there is no such file, or it is not what its ending says.
    """
    kind = READERS.get(path.suffix.lower())
    if kind is None:
        raise DataError(
            f"{where}: {path} must end in one of {', '.join(READERS)} but ends in "
            f"{path.suffix!r}; convert it or rename it"
        )
    try:
        if kind == "mat":
            return Table(path, _read_mat(path), 1)
        if kind == "csv":
            return Table(path, _by_name(_read_csv(path)), 2)
        read = pa.parquet.read_table if kind == "parquet" else pa.feather.read_table
        return Table(path, _by_name(read(path)), 1)
    except FileNotFoundError:
        raise DataError(f"{where}: there is no file {path}; check the path") from None
    except (pa.ArrowInvalid, OSError, ValueError, NotImplementedError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DataError(f"{where}: {path} cannot be read as {kind} ({reason})") from error


def _read_csv(path: Path) -> pa.Table:
    """Read every column as text: whether it is a number matters only for those that are used."""
    with path.open(encoding="utf-8-sig", errors="replace") as opened:
        header = opened.readline()
    delimiter = max(",;\t", key=header.count)
    parse = pa.csv.ParseOptions(delimiter=delimiter)
    names = pa.csv.open_csv(path, parse_options=parse).schema.names
    convert = pa.csv.ConvertOptions(column_types=dict.fromkeys(names, pa.string()))
    return pa.csv.read_csv(path, parse_options=parse, convert_options=convert)


def _read_mat(path: Path) -> dict[str, FloatArray]:
    """Every variable of a MAT file that is a vector of numbers."""
    from scipy.io import loadmat

    variables = loadmat(path, squeeze_me=True)
    return {
        name: np.atleast_1d(values).astype(np.float64)
        for name, values in variables.items()
        if isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "fiub"
    }


def _by_name(table: pa.Table) -> dict[str, pa.ChunkedArray]:
    return {name.strip(): table.column(i) for i, name in enumerate(table.column_names)}


def _floats(column: pa.ChunkedArray) -> FloatArray:
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        trimmed = pa.compute.utf8_trim_whitespace(column)
        absent = pa.compute.is_in(trimmed, value_set=pa.array(MISSING))
        column = pa.compute.if_else(absent, None, trimmed)
    elif not (
        pa.types.is_floating(column.type)
        or pa.types.is_integer(column.type)
        or pa.types.is_null(column.type)
        or pa.types.is_boolean(column.type)
        or pa.types.is_decimal(column.type)
    ):
        raise ValueError("not numbers")
    floats = column.cast(pa.float64()).to_numpy()
    return np.array(floats, dtype=np.float64)


def check_times(times: FloatArray, where: str, first_row: int = 0) -> None:
    """Refuse times that are not finite and strictly increasing, naming the first bad row."""
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise DataError(
            f"{where}: row {bad[0] + first_row}: the time must be a finite number but is "
            f"{times[bad[0]]}; remove the row or mend it"
        )
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back):
        row = back[0] + 1
        how = "repeats" if times[row] == times[row - 1] else "goes back from"
        raise DataError(
            f"{where}: row {row + first_row}: the time {times[row]:.9g} {how} "
            f"{times[row - 1]:.9g} of the row before; times must increase: sort the rows and "
            "remove repeated ones"
        )
