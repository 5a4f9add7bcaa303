"""Reads tables in text files, such as CSV files of programs, loggers and spreadsheets.

The encoding, the lines above the table, and the separators of cells and decimals are determined
from the beginning of the file. Then Arrow reads the file, with numbers directly as numbers. If this
fails, all columns are read as text, because an unused column may contain anything.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final

import pyarrow as pa
import pyarrow.csv as pacsv
from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.cells import MISSING, decimal_in, looks_like_a_number
from cluster_est.problem.tables.formats.end_of_table import end_of_table
from cluster_est.problem.tables.formats.header import Header, find_header, refuse_several
from cluster_est.problem.tables.formats.table_format import TableFormat
from cluster_est.problem.tables.measured_table import LineNumbers, MeasuredTable, Reading, once
from cluster_est.toml import inline

HEAD_BYTES: Final = 2**18
"""Number of bytes of the beginning that are examined."""
LINES_OF_LAYOUT: Final = 400
"""Number of lines in which the header is searched for, after those that the user skips."""
LINES_LOOKED_AT: Final = 1500
"""Number of lines that determine the decimal separator and the numeric columns."""
MOST_LINES_OF_CELL: Final = 10
COMMENTS: Final = ("#", "%", "//")
"""Signs at the beginning of comment lines."""
DELIMITERS: Final = (",", ";", "\t", "|", " ")
MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""Byte order marks, with their encodings."""
OTHER_FORMATS: Final = (
    (b"MDF  ", ".mdf"),
    (b"TDSm", ".tdms"),
    (b"\x89HDF", ".h5"),
    (b"PK\x03\x04", ".xlsx"),
    (b"PAR1", ".parquet"),
    (b"MATLAB ", ".mat"),
)
"""First bytes of files in other formats, which may have a wrong extension."""
GUESSED_ENCODING: Final = "cp1252"
"""Encoding of text without a byte order mark that is not UTF-8: Windows in Western Europe."""
MOST_NULS_OF_TEXT, LEAST_NULS_OF_UTF16 = 0.05, 0.3
"""Shares of zero bytes at the two positions of a pair that identify UTF-16 without a mark."""


@dataclass(frozen=True)
class _Layout:
    """The layout of a file.

    Attributes
    ----------
    encoding
        Encoding of the text.
    delimiter
        Separator of cells; a blank means any number of blanks.
    header
        Names and units of the columns, and the line of the first row.
    comments
        Whether lines that begin like comments are not rows.
    decimal
        Decimal separator, as in `MeasuredTable`.
    numeric
        Positions of the columns that are read as numbers.
    notes
        Sentences on how the file is read.
    end
        Number of bytes up to the end of the table if there are lines below it; None otherwise.
    """

    encoding: str
    delimiter: str
    header: Header
    comments: bool
    decimal: str
    numeric: tuple[int, ...]
    notes: tuple[str, ...]
    end: int | None = None

    @property
    def width(self) -> int:
        return len(self.header.names)


class DelimitedText(TableFormat):
    """Text files with rows of cells."""

    name: ClassVar[str] = "csv"
    endings: ClassVar[tuple[str, ...]] = (
        ".csv", ".tsv", ".txt", ".dat", ".asc", ".csv.gz", ".lvm", ".log", ".prn", ".tab",
    )  # fmt: skip
    keys: ClassVar[tuple[str, ...]] = ("encoding", "skip_rows", "decimal")

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        head = _head(path)
        kind = next((ending for mark, ending in OTHER_FORMATS if head.startswith(mark)), "")
        if kind:
            raise DataError(
                f"must be text, but is a {kind} file; rename it so that its name ends accordingly"
            )
        mark = head.lstrip()[:1]
        if mark in (b"<", b"{"):
            what = "XML or HTML" if mark == b"<" else "JSON"
            raise DataError(f"must be a table, but is {what}; save it as csv")
        encoding, note = _encoding(head, reading.encoding)
        try:
            return _read(path, head, encoding, note, reading)
        except _NotUtf8Error:
            with _opened(path) as file:
                guess = _guessed_encoding(file.read())
            return _read(path, head, *guess, reading)


class _NotUtf8Error(Exception):
    """Raised if the text of a file is not UTF-8 after its examined beginning."""


def _head(path: Path) -> bytes:
    with _opened(path) as file:
        head: bytes = file.read(HEAD_BYTES)
    return head


def _opened(path: Path) -> Any:
    return gzip.open(path, "rb") if path.suffix.lower() == ".gz" else path.open("rb")


def _encoding(head: bytes, given: str) -> tuple[str, str]:
    """Return the encoding of a text, and a note on it or ""."""
    for mark, encoding in MARKS:
        if head.startswith(mark):
            return encoding, "" if encoding == "utf-8" else f"its encoding is {encoding.upper()}"
    if given:
        return given, ""
    first, second = head[:4096:2].count(0), head[1:4096:2].count(0)
    pairs = len(head[:4096]) // 2
    for few, many, encoding in ((first, second, "utf-16-le"), (second, first, "utf-16-be")):
        if pairs and many > LEAST_NULS_OF_UTF16 * pairs and few < MOST_NULS_OF_TEXT * pairs:
            return encoding, (
                f"its text has no byte order mark and is read as {encoding.upper()}, which is a "
                "guess; if it is wrong, set encoding"
            )
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return _guessed_encoding(head)
    return "utf-8", ""


def _guessed_encoding(text: bytes) -> tuple[str, str]:
    try:
        text.decode(GUESSED_ENCODING)
    except UnicodeDecodeError as error:
        raise DataError(
            f"must have a known encoding, but is neither UTF-8 nor {GUESSED_ENCODING} (byte "
            f'{error.start}); add encoding = "NAME", such as "shift_jis", or save it as UTF-8'
        ) from None
    return GUESSED_ENCODING, (
        f"its text is not UTF-8 and is read as {GUESSED_ENCODING}, which is a guess; if it is "
        f"wrong, change encoding = {inline(GUESSED_ENCODING)}"
    )


def _read(path: Path, head: bytes, encoding: str, note: str, reading: Reading) -> MeasuredTable:
    try:
        text = codecs.getincrementaldecoder(encoding)(errors="replace").decode(head)
    except LookupError:
        raise DataError(
            f"must have an encoding that Python knows, but encoding is {encoding!r}; write one "
            'such as "utf-8", "cp1252" or "utf-16"'
        ) from None
    lines = re.split(r"\r\n|\n|\r", text.removeprefix("\ufeff"))
    if len(head) == HEAD_BYTES and len(lines) > 1:
        lines.pop()  # the last line is truncated
    layout = _layout(lines, encoding, reading)
    if note:
        layout = replace(layout, notes=(note, *layout.notes))
    layout = _without_what_is_below(path, layout, lines)
    table, skipped = _parse(path, layout)
    table = _without_empty_end(table)
    if not table.num_rows:
        _explain(path, layout)
    if skipped:
        kinds = "lines" if skipped > 1 else "line"
        said = f"{skipped} {kinds} of comments between its rows are skipped"
        layout = replace(layout, notes=(*layout.notes, said))
    pairs = [(name, table.column(i)) for i, name in enumerate(layout.header.names)]
    columns, unusable = once(pairs)
    names = layout.header.names
    return MeasuredTable(
        path,
        columns,
        unusable,
        layout.decimal,
        {names[i].strip(): unit for i, unit in layout.header.units.items()},
        notes=layout.notes,
        found=_found(layout, reading, guessed=bool(note)),
        lines=_Lines(path, layout),
    )


def _without_what_is_below(path: Path, layout: _Layout, lines: Sequence[str]) -> _Layout:
    """Return the layout with the end of the table, if there are lines below the table."""
    if path.suffix.lower() == ".gz" or layout.encoding.startswith(("utf-16", "utf-32")):
        return layout

    def cells_of(line: bytes) -> list[str] | None:
        text = line.decode(layout.encoding, "replace").strip("\r\n")
        if layout.comments and text.lstrip().startswith(COMMENTS):
            return None
        return [cell.strip() for cell in _cells(text, layout.delimiter)] if text.strip() else []

    columns = _columns(lines, layout.delimiter, layout.header, comments=layout.comments)
    found = end_of_table(path, columns, cells_of)
    if found is None:
        return layout
    return replace(layout, notes=(*layout.notes, found.said), end=found.size)


def _found(layout: _Layout, reading: Reading, *, guessed: bool) -> dict[str, Any]:
    """Return the options of `Reading` that were determined from the file."""
    found: dict[str, Any] = {}
    if guessed and not layout.encoding.startswith("utf-16"):
        found["encoding"] = layout.encoding
    if layout.header.header and reading.skip_rows is None:
        found["skip_rows"] = layout.header.header
    return found


def _layout(lines: Sequence[str], encoding: str, reading: Reading) -> _Layout:
    start = reading.skip_rows or 0
    if start > len(lines):
        raise DataError(
            f"must have more lines than skip_rows, which is {start}, but has fewer; lower skip_rows"
        )
    lines = lines[: start + LINES_LOOKED_AT]
    found = _table(lines[: start + LINES_OF_LAYOUT], start, given=reading.skip_rows is not None)
    delimiter, header, comments = found or _plain(lines, start)
    if reading.skip_rows is None:
        refuse_several(header)
    cells = _columns(lines, delimiter, header, comments=comments)
    decimal = reading.decimal or decimal_in(cell for column in cells for cell in column)
    numeric = _numeric(cells, decimal or ("." if delimiter == "," else ""))
    if decimal == "" and delimiter != ",":
        decimal = ";"
    notes = _notes(header, delimiter, reading)
    return _Layout(encoding, delimiter, header, comments, decimal, numeric, notes)


def _table(lines: Sequence[str], start: int, *, given: bool) -> tuple[str, Header, bool] | None:
    """Return the delimiter, the header, and whether comment lines are not rows."""
    best: tuple[str, Header, bool] | None = None
    marked = any(line.lstrip().startswith(COMMENTS) for line in lines)
    for delimiter in DELIMITERS:
        if not any(delimiter in line for line in lines):
            continue
        for comments in (True, False) if marked else (True,):
            rows = _rows(lines, delimiter, comments=comments)
            if given:  # the first line after the skipped ones is the header
                rows = [None if i < start else row for i, row in enumerate(rows)]
            found = find_header(rows, start)
            if found is not None and (found.header is not None or not comments):
                break
        if found is None or (best is not None and found.score <= best[1].score):
            continue
        best = delimiter, found, comments
    return best


def _rows(lines: Sequence[str], delimiter: str, *, comments: bool) -> list[list[str] | None]:
    """Return the cells of lines; None for empty lines, and for comments if they are not rows."""
    found: list[list[str] | None] = []
    for line in _logical(lines):
        if line is None:
            found.append(None)
            continue
        bare = line.strip()
        mark = next((each for each in COMMENTS if bare.startswith(each)), "")
        if not bare or (mark and comments):
            found.append(None)
        else:
            found.append(_cells(bare.removeprefix(mark).strip() if mark else line, delimiter))
    return found


def _logical(lines: Sequence[str]) -> Iterator[str | None]:
    """Yield lines; lines with a quoted multi-line cell are joined in place of the last one."""
    begun = ""
    for i, line in enumerate(lines):
        if not begun and line.count('"') % 2:
            below = lines[i + 1 : i + MOST_LINES_OF_CELL]
            begun = line if any(each.count('"') % 2 for each in below) else ""
            yield None if begun else line
        elif begun:
            begun = f"{begun} {line}"
            yield None if begun.count('"') % 2 else begun
            begun = begun if begun.count('"') % 2 else ""
        else:
            yield line


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except (csv.Error, StopIteration):  # for example a cell that is too long for the csv module
        return line.split(delimiter)


def _plain(lines: Sequence[str], start: int) -> tuple[str, Header, bool]:
    """Return the layout of a table that begins with the first nonempty line."""
    there = [i for i in range(start, len(lines)) if lines[i]]
    if not there:
        raise DataError("must have a header and rows of numbers, but is empty; check the file")
    line = lines[there[0]]
    delimiter = max(",;\t", key=line.count)
    names = tuple(_cells(line, delimiter))
    return delimiter, Header(names, there[0], there[0] + 1, {}, 0, 0.0), True


def _columns(
    lines: Sequence[str], delimiter: str, header: Header, *, comments: bool
) -> list[list[str]]:
    """Return the cells of each column in the examined lines, without missing values."""
    width = len(header.names)
    found: list[list[str]] = [[] for _ in range(width)]
    for row in _rows(lines[header.first :], delimiter, comments=comments):
        if row is not None and len(row) == width:
            for column, cell in zip(found, map(str.strip, row), strict=True):
                if cell not in MISSING:
                    column.append(cell)
    return found


def _numeric(cells: Sequence[Sequence[str]], decimal: str) -> tuple[int, ...]:
    """Return the positions of columns that are numeric with this decimal separator."""
    if decimal not in (",", "."):
        return ()
    other = "," if decimal == "." else "."
    return tuple(
        i
        for i, column in enumerate(cells)
        if column and all(looks_like_a_number(c) and other not in c for c in column)
    )


def _notes(header: Header, delimiter: str, reading: Reading) -> tuple[str, ...]:
    notes = []
    line = header.header
    if line is None:
        notes.append(
            f"it has no header, so its columns are named {header.names[0]} to {header.names[-1]}"
        )
    elif line and reading.skip_rows is None:
        notes.append(
            f"its header is in row {line + 1}; the rows above it do not belong to the table "
            f"(skip_rows = {line})"
        )
    if header.units:
        shown = ", ".join(f"{header.names[i]} {unit}" for i, unit in [*header.units.items()][:6])
        notes.append(f"the row below its header gives units: {shown}")
    if delimiter == " ":
        notes.append("its cells are separated by blanks")
    return tuple(notes)


def _parse(path: Path, layout: _Layout) -> tuple[pa.Table, int]:
    """Return the columns in order, and the number of skipped comment lines."""
    skipped: list[None] = []

    def meet(row: Any) -> str:
        if layout.comments and row.text.lstrip().startswith(COMMENTS):
            skipped.append(None)
            return "skip"
        return "error"

    parse = pacsv.ParseOptions(
        delimiter="\t" if layout.delimiter == " " else layout.delimiter, invalid_row_handler=meet
    )
    names = [str(i) for i in range(layout.width)]
    read = pacsv.ReadOptions(
        column_names=names, skip_rows=layout.header.first, encoding=layout.encoding
    )
    for numeric in dict.fromkeys((layout.numeric, ())):
        types = dict.fromkeys(names, pa.string()) | {str(i): pa.float64() for i in numeric}
        convert = pacsv.ConvertOptions(
            column_types=types,
            null_values=MISSING,
            strings_can_be_null=False,
            decimal_point="," if layout.decimal == "," else ".",
        )
        skipped.clear()
        try:
            return pacsv.read_csv(_source(path, layout), read, parse, convert), len(skipped)
        except (pa.ArrowInvalid, UnicodeError) as error:
            last = error
        if "conversion error to double" not in str(last):
            break
    if "invalid UTF8" in str(last) and layout.encoding == "utf-8":
        raise _NotUtf8Error from last
    _explain(path, layout)
    raise last


def _source(path: Path, layout: _Layout) -> Any:
    """Return the source for Arrow; blanks between cells are replaced by tabs."""
    if layout.delimiter != " ":
        if path.suffix.lower() == ".gz":
            return pa.CompressedInputStream(pa.OSFile(str(path)), "gzip")
        if layout.end is None:
            return str(path)
        return pa.BufferReader(pa.memory_map(str(path)).read_buffer(layout.end))
    with _opened(path) as file:
        text = file.read() if layout.end is None else file.read(layout.end)
    text = re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)", b"", text)
    return pa.BufferReader(re.sub(rb"[ \t]+", b"\t", text))


def _without_empty_end(table: pa.Table) -> pa.Table:
    """Return a table without empty rows at its end."""
    end = table.num_rows
    while end and all(c[end - 1].as_py() in (None, "") for c in table.columns):
        end -= 1
    return table.slice(0, end)


def _explain(path: Path, layout: _Layout) -> None:
    """Raise an error for the usual faults of a text file: a wrong number of cells, or no rows."""
    count = 0
    for number, line in _Lines(path, layout).rows():
        cells = _cells(line, layout.delimiter)
        count += 1
        if len(cells) != layout.width:
            raise DataError(
                f"must have {layout.width} cells in each row, as many as in its header, but row "
                f"{number} has {len(cells)}; correct that row, or set skip_rows to the number of "
                "lines above the header"
            )
    if not count:
        raise DataError(
            "must have a header and rows of numbers, but has only a header; check the file"
        )


@dataclass(frozen=True)
class _Lines(LineNumbers):
    """The lines of a text file that are rows of its table."""

    path: Path
    layout: _Layout

    def number(self, index: int) -> int:
        for i, (number, _) in enumerate(self.rows()):
            if i == index:
                return number
        return index + self.layout.header.first + 1

    def rows(self) -> Iterator[tuple[int, str]]:
        """Yield the rows with their line numbers, as in an editor."""
        layout = self.layout
        with _opened(self.path) as raw:
            text = io.TextIOWrapper(raw, encoding=layout.encoding, errors="replace")
            for number, line in enumerate(text, 1):
                bare = line.rstrip("\r\n")
                if number <= layout.header.first or not bare:
                    continue
                comment = layout.comments and bare.lstrip().startswith(COMMENTS)
                if not (comment and len(_cells(bare, layout.delimiter)) != layout.width):
                    yield number, bare
