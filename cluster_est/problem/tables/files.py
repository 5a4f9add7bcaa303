"""Measured tables: CSV, Parquet, Feather and MAT, as columns of numbers."""

from __future__ import annotations

import csv
import io
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from pyarrow import feather

from cluster_est.errors import DataError
from cluster_est.problem.tables.mat_file import contents
from workers.fmu.description import nearest
from workers.messages import FloatArray
from workers.messages.checks import as_path
from workers.messages.types import by_content

MISSING = ["", "NaN", "nan", "NAN", "NA", "N/A", "null", "None"]


def is_text(column: pa.ChunkedArray) -> bool:
    """Return True for a column of texts."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def is_numeric(column: pa.ChunkedArray) -> bool:
    """Return True for a column of numbers, or of true and false."""
    kinds = ("floating", "integer", "null", "boolean", "decimal")
    return any(getattr(pa.types, f"is_{kind}")(column.type) for kind in kinds)


def trimmed_cells(column: pa.ChunkedArray, *, decimal_comma: bool) -> pa.ChunkedArray:
    """Text ready to be numbers: without blanks, null where nothing was measured."""
    trimmed = pa.compute.utf8_trim_whitespace(column)
    if decimal_comma and not pa.compute.any(pa.compute.match_substring(trimmed, ".")).as_py():
        trimmed = pa.compute.replace_substring(trimmed, ",", ".")
    absent = pa.compute.is_in(trimmed, value_set=pa.array(MISSING, trimmed.type))
    return pa.compute.if_else(absent, None, trimmed)


def with_switches(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """Text in which True and False, in any case, are 1 and 0."""
    lowered = pa.compute.utf8_lower(cells)
    for word, number in (("true", "1"), ("false", "0")):
        cells = pa.compute.if_else(pa.compute.equal(lowered, word), number, cells)
    return cells


def as_numbers(column: pa.ChunkedArray) -> FloatArray:
    """Return the cells as floats, NaN for empty ones."""
    # unsafe: integers beyond 2**53, like times in nanoseconds, are rounded rather than refused
    return np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def first_text(cells: pa.ChunkedArray) -> int:
    """Position of the first cell that is no number, by halving."""
    good, bad = 0, len(cells)
    while bad - good > 1:
        middle = (good + bad) // 2
        try:
            as_numbers(cells.slice(good, middle - good))
            good = middle
        except pa.ArrowInvalid:
            bad = middle
    return good


READERS = {
    ".csv": "csv", ".tsv": "csv", ".txt": "csv",
    ".parquet": "parquet", ".pq": "parquet",
    ".feather": "feather", ".arrow": "feather", ".ipc": "feather",
    ".mat": "mat",
}  # fmt: skip
MOST_MATRIX_SIGNALS = 1000
"""Signals in a matrix, which has fewer signals than samples."""
MOST_NAMED_COLUMNS = 30
"""Columns that a message names."""


@by_content
@dataclass(frozen=True)
class MeasuredTable:
    """A measured file, its columns still as they are in the file.

    Attributes
    ----------
    path
        The file that it came from, or a name for it, for messages.
    columns
        Arrow arrays or NumPy arrays by name.
    unusable
        Why a column that the file has cannot be used, by name.
    delimiter
        What stands between the cells of a text file; empty for other files.
    """

    path: Path | str
    columns: dict[str, pa.ChunkedArray | FloatArray] = field(repr=False)
    unusable: dict[str, str] = field(default_factory=dict)
    delimiter: str = ""

    def numbers(self, name: str, where: str) -> FloatArray:
        """A column as floats, NaN where nothing was measured.

        Raises
        ------
        DataError
            If there is no such column, or if something in it is not a number.
        """
        if name in self.unusable:
            raise DataError(f"{where}: {self.path}, column {name!r}: {self.unusable[name]}")
        if name not in self.columns:
            raise DataError(f"{where}: {self.without(name)}")
        column = self.columns[name]
        if isinstance(column, np.ndarray):
            return column
        if pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        if is_text(column):
            cells = trimmed_cells(column, decimal_comma=self.delimiter not in ("", ","))
            try:
                return as_numbers(cells)
            except pa.ArrowInvalid:
                cells = with_switches(cells)
            try:
                return as_numbers(cells)
            except pa.ArrowInvalid:
                self._refuse(name, column, first_text(cells), where)
        if not is_numeric(column):
            raise DataError(
                f"{where}: {self.path}, column {name!r}: must hold numbers but holds "
                f"{column.type}; convert it to numbers (a time to seconds)"
            )
        return as_numbers(column)

    def without(self, name: str) -> str:
        """The sentence on a column that the table does not have: the nearest one, and all."""
        names = [*self.columns]
        found = nearest(name, names)
        fields = [each for each in names if each.endswith(f".{name}")]
        if len(fields) == 1:
            found = f"; did you mean {fields[0]!r}?"
        if not names and self.unusable:
            found = "; " + "; ".join(f"{n!r} {why}" for n, why in [*self.unusable.items()][:5])
        listed = ", ".join(repr(each) for each in names[:MOST_NAMED_COLUMNS])
        more = len(names) - MOST_NAMED_COLUMNS
        listed += f" and {more} more" if more > 0 else ""
        ending = f"{found} Its columns are {listed}" if found.endswith("?") else found
        return f"{self.path} has no column {name!r}{ending}"

    def row(self, index: int) -> int:
        """The row of the file, as an editor shows it, that the values at an index are from."""
        if not self.delimiter:
            return index + 1
        for i, (line, _) in enumerate(_lines(Path(self.path), self.delimiter)):
            if i == index + 1:
                return line
        return index + 2

    def _refuse(self, name: str, column: pa.ChunkedArray, index: int, where: str) -> NoReturn:
        value = repr(column[index].as_py())
        raise DataError(
            f"{where}: {self.path}, column {name!r}, row {self.row(index)}: must be a number but "
            f"is {value if len(value) < 60 else value[:57] + '...'}; correct it, or leave it empty "
            "where nothing was measured"
        )


def read_table(path: str | Path, where: str = "table") -> MeasuredTable:
    """Read a measured file; its ending says what it is.

    Parameters
    ----------
    path
        Of a csv, parquet, feather or MAT file.
    where
        Opens each message.

    Raises
    ------
    DataError
        If there is no such file, or it is not what its ending says.
    """
    path = as_path(path, where, DataError)
    kind = READERS.get(path.suffix.lower())
    if kind is None:
        raise DataError(
            f"{where}: {path} must end in one of {', '.join(READERS)} but ends in "
            f"{path.suffix!r}; convert it or rename it"
        )
    read = {"csv": _read_csv, "mat": _read_mat, "parquet": _read_parquet, "feather": _read_feather}
    try:
        return read[kind](path)
    except DataError as error:
        raise DataError(f"{where}: {path} {error}") from None
    except FileNotFoundError:
        raise DataError(f"{where}: there is no file {path}; check the path") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DataError(
            f"{where}: {path} must be a {kind} file that can be read but is not ({reason}); "
            "check that it is complete, or save it again"
        ) from error


def _read_csv(path: Path) -> MeasuredTable:
    """Read every column as text: whether it is a number matters only for those that are used."""
    with path.open(encoding="utf-8-sig", errors="replace") as opened:
        header = next((line for line in opened if line.strip("\r\n")), "")
    delimiter = max(",;\t", key=header.count)
    parse = pacsv.ParseOptions(delimiter=delimiter)
    try:
        with pacsv.open_csv(path, parse_options=parse) as opened_csv:
            names = opened_csv.schema.names
        convert = pacsv.ConvertOptions(column_types=dict.fromkeys(names, pa.string()))
        table = pacsv.read_csv(path, parse_options=parse, convert_options=convert)
    except (pa.ArrowInvalid, UnicodeDecodeError):
        _explain_csv(path, delimiter)
        raise
    return named_columns(path, table, delimiter)


def _explain_csv(path: Path, delimiter: str) -> None:
    """Say what is wrong in a text file that Arrow refused, if it is one of the usual things."""
    with path.open("rb") as opened:
        for number, text in enumerate(opened, 1):
            try:
                text.decode()
            except UnicodeDecodeError:
                raise DataError(
                    f"must be text in UTF-8 but row {number} is not; save it as UTF-8"
                ) from None
    width = count = 0
    for line, cells in _lines(path, delimiter):
        width, count = width or len(cells), count + 1
        if len(cells) != width:
            raise DataError(
                f"must have as many cells in each row as in its header, {width}, but row {line} "
                f"has {len(cells)}; correct that row"
            )
    if count < 2:
        has = "only a header" if count else "nothing in it"
        raise DataError(f"must have a header and rows of numbers but has {has}; check the file")


def _lines(path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """The lines of a text file that are not empty, with the number that an editor shows."""
    with path.open(encoding="utf-8-sig", newline="") as opened:
        reader = csv.reader(opened, delimiter=delimiter)
        while True:
            try:
                cells = next(reader)
            except StopIteration:
                return
            except csv.Error:  # a cell beyond Python's limit; it is still a line
                cells = []
            if cells:
                yield reader.line_num, cells


def _read_parquet(path: Path) -> MeasuredTable:
    # read_table would make columns of a folder's name like "run=3"
    with pq.ParquetFile(path, page_checksum_verification=True) as opened:
        table = opened.read()
    table.validate(full=True)
    return named_columns(path, table)


def _read_feather(path: Path) -> MeasuredTable:
    table = feather.read_table(path, memory_map=False)
    table.validate(full=True)
    return named_columns(path, table)


def _read_mat(path: Path) -> MeasuredTable:
    """Every vector of numbers in a MAT file, those in structures and in matrices too."""
    from scipy.io import loadmat

    content = path.read_bytes()
    try:
        found = contents(content)
        wanted = None if found is None else found.numbers
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            variables = loadmat(io.BytesIO(content), squeeze_me=True, variable_names=wanted)
            if found is not None and found.fields:
                variables |= loadmat(io.BytesIO(found.fields), squeeze_me=True)
    except NotImplementedError:
        raise DataError(
            "must be a MAT file of version 7 or older but is of version 7.3, which is HDF5; save "
            'it with save(..., "-v7")'
        ) from None
    except OSError:
        raise
    except Exception as error:  # SciPy meets a damaged file with exceptions of every kind
        raise DataError(
            f"must be a MAT file but cannot be read as one ({type(error).__name__}: {error}); "
            "save it again"
        ) from error
    columns: dict[str, pa.ChunkedArray | FloatArray] = {}
    others = {} if found is None else found.others
    unusable = {name: f"must be a vector of numbers but is {it}" for name, it in others.items()}
    for name, values in variables.items():
        numbers = np.atleast_1d(values) if isinstance(values, np.ndarray) else None
        if numbers is not None and numbers.dtype.kind not in "fiub":
            numbers = None
        if numbers is not None and numbers.ndim == 1:
            columns[name] = numbers.astype(np.float64)
        elif not name.startswith("__"):
            shape = " x ".join(str(n) for n in np.shape(values))
            unusable[name] = f"must be a vector of numbers but is {shape or 'a'} " + (
                f"{values.dtype}" if isinstance(values, np.ndarray) else type(values).__name__
            )
            if (
                numbers is not None
                and numbers.ndim == 2
                and min(numbers.shape) <= MOST_MATRIX_SIGNALS
            ):
                signals = numbers if len(numbers) < len(numbers.T) else numbers.T
                own = {f"{name}[{i}]": each for i, each in enumerate(signals)}
                columns |= {key: each.astype(np.float64) for key, each in own.items()}
                unusable[name] += f"; name one of its signals, {name}[0] to {[*own][-1]}"
    return MeasuredTable(path, columns, unusable)


def repeated(count: int) -> str:
    """The reason why a column that is there several times cannot be used."""
    return f"must be there once but {count} columns have that name; rename them"


def named_columns(path: Path | str, table: pa.Table, delimiter: str = "") -> MeasuredTable:
    """Columns by name, without the blanks that some programs put around names."""
    names = [name.strip() for name in table.column_names]
    unusable = {name: repeated(count) for name, count in Counter(names).items() if count > 1}
    columns = {name: table.column(i) for i, name in enumerate(names) if name not in unusable}
    return MeasuredTable(path, columns, unusable, delimiter)
