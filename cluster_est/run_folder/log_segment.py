"""A segment of an evaluation log: written batch by batch, and read with verification.

A segment is an Arrow IPC stream. Its schema and each batch contain a seal in their metadata: the
checksum of the message, its length, and the number of rows up to its end. A message is passed to
Arrow only if its checksum matches, because Arrow may crash or give wrong data for a damaged one.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.whole_files import MEND, SEAL, SEAL_KEY, is_damaged, sealed
from workers.messages import FloatArray, Outcome, Want, content_hash

SCHEMA = pa.schema(
    [
        ("key", pa.string()),
        ("want", pa.string()),
        ("search", pa.string()),
        ("evaluation", pa.int64()),
        ("purpose", pa.string()),
        ("experiment", pa.string()),
        ("values", pa.list_(pa.float64())),
        ("effects", pa.list_(pa.string())),
        ("status", pa.string()),
        ("message", pa.string()),
        ("cost", pa.float64()),
        ("residuals", pa.list_(pa.float64())),
        ("residuals_hash", pa.string()),
        ("constraints", pa.list_(pa.float64())),
        ("seconds", pa.float64()),
        ("worker", pa.string()),
        ("variables", pa.list_(pa.string())),
        ("times", pa.list_(pa.float64())),
        ("trajectory", pa.list_(pa.float64())),
        ("ended", pa.float64()),
        ("bound", pa.float64()),
        ("steps", pa.int64()),
    ]
)
"""`trajectory` is (times, variables) in row-major order, if requested. `ended` is the time of the
answer, in seconds since 1970. `bound` is the sum of squares above which it should end early, null
for none. `steps` are those of the solver, 0 if unknown. `residuals_hash` remains if residuals are
removed."""
HASH_LENGTH = 32
"""Number of characters of a hash of residuals: 128 bits."""
ROWS_PER_BATCH = 2000
"""Number of rows of a batch in a segment without its large columns."""
LARGE_LOG_COLUMNS = ("residuals", "variables", "times", "trajectory")
"""Columns that may be omitted; a resumed run simulates those rows again."""


def logged_cost(outcome: Outcome, want: Want) -> float:
    """Return the sum of squares of an outcome's residuals, NaN for a failed outcome.

    If only the sum of absolute values is known, return that.
    """
    if outcome.residuals is None:
        return np.nan
    with np.errstate(over="ignore"):  # it may be infinite
        sizes = outcome.residuals if want == "absolutes" else outcome.residuals**2
        return float(np.add.reduce(sizes))


def residuals_hash(residuals: FloatArray | None) -> str | None:
    """Return a hash of the bits of residuals, to compare them after they were removed."""
    return None if residuals is None else content_hash([residuals.tobytes()])[:HASH_LENGTH]


END_OF_STREAM = b"\xff\xff\xff\xff\x00\x00\x00\x00"
BEGIN = re.compile(rb"(?=\xff\xff\xff\xff)")
"""Beginning of a message, which is at a multiple of 8 bytes."""
LARGEST_HEAD = 2**20
Message = tuple[int, int]
"""End of a message, and number of rows of the segment up to it."""
_SEGMENT_SEAL = re.compile(rb"cluster-est crc32:[0-9a-f]{8} bytes:(\d{12}) rows:(\d{12})")
_INVALID = (pa.ArrowException, OSError, EOFError, ValueError, KeyError, MemoryError)
"""Exceptions raised when a damaged message is read."""


def segments(folder: Path) -> list[Path]:
    """Return the segments of a log, the oldest first."""
    return sorted(folder.glob("*.arrows"))


class SegmentWriter:
    """Appends sealed batches to a file.

    Parameters
    ----------
    file
        An empty file.
    schema
        Schema of the batches.
    """

    def __init__(self, file: BinaryIO, schema: pa.Schema) -> None:
        self._file, self._rows = file, 0
        self._schema = schema.with_metadata({**(schema.metadata or {}), SEAL_KEY: _seal(0, 0)})
        head = self._schema.serialize().to_pybytes()
        self._head = len(head)
        file.write(_filled(head, 0))

    def write(self, batch: pa.RecordBatch) -> None:
        """Append a batch with a single write."""
        self._rows += batch.num_rows
        stream = io.BytesIO()
        writer = pa.ipc.new_stream(stream, self._schema)
        batch = batch.replace_schema_metadata(self._schema.metadata)
        writer.write_batch(batch, custom_metadata={SEAL_KEY: _seal(0, self._rows)})
        self._file.write(_filled(stream.getvalue()[self._head :], self._rows))

    def close(self) -> None:
        """End the stream without closing the file."""
        self._file.write(END_OF_STREAM)


def _seal(size: int, rows: int) -> str:
    return f"{SEAL} bytes:{size:012d} rows:{rows:012d}"


def _filled(message: bytes, rows: int) -> bytes:
    seal = _seal(len(message), rows).encode()
    return sealed(message.replace(_seal(0, rows).encode(), seal, 1))


class SegmentReader:
    """Reads the intact batches of a segment; a later call continues in a segment that has grown.

    Attributes
    ----------
    end
        End of the last intact message; 0 before the schema.
    schema
        None before it was read, and if it is damaged.
    lost
        Number of rows that are known to exist but are damaged.
    damaged
        Whether any part is damaged and not merely cut off.
    torn
        Whether other data follow the last intact message.
    closed
        Whether only the end of the stream follows, so the segment is complete.
    """

    def __init__(self) -> None:
        self.end = 0
        self.schema: pa.Schema | None = None
        self.damaged = self.torn = self.closed = False
        self._rows = self._passed_over = self._cut_off = 0

    @property
    def lost(self) -> int:
        return self._passed_over + self._cut_off

    def batches(self, content: pa.Buffer) -> Iterator[tuple[int, pa.RecordBatch]]:
        """Yield each new batch, with its position in the content of the segment.

        Damaged data are skipped. A truncated end is left for the next call, because it may be
        incomplete.
        """
        view = memoryview(content).cast("B")  # a buffer of Arrow has signed bytes
        while not _is_end(view, self.end):
            begin, found = self.end, _sealed_message(view, self.end)
            if found is None:
                begin, found = _following(view, self.end)
                if found is None:
                    break
                self.damaged = True
            self.end, rows = found
            batch = self._parsed(content.slice(begin, self.end - begin), rows, first=begin == 0)
            if batch is not None:
                yield begin, batch
        self._judge(view)

    def check(self, path: Path, *, ended: bool) -> None:
        """Refuse a segment with damaged data, or a truncated segment of a finished run.

        Raises
        ------
        RunFolderError
            If the segment is damaged.
        """
        if self.damaged or (ended and not self.closed):
            what = (
                f"{self.lost} of its simulations have" if self.lost else "a part of its content has"
            )
            raise RunFolderError(
                f"{path}: the file is damaged: {what} changed since it was written; {MEND}"
            )

    def _parsed(self, part: pa.Buffer, rows: int, *, first: bool) -> pa.RecordBatch | None:
        """Return the batch in a message; None for the schema and for invalid messages."""
        batch = None
        try:
            if first:
                self.schema = _schema(part)
            elif self.schema is not None:
                batch = pa.ipc.read_record_batch(pa.ipc.read_message(part), self.schema)
        except _INVALID:
            batch, self.damaged = None, True
        count = 0 if batch is None else batch.num_rows
        self._passed_over += max(rows - self._rows - count, 0)
        self._rows = rows
        return batch

    def _judge(self, view: memoryview) -> None:
        """Determine whether the rest after the last message is empty, truncated or damaged."""
        rest = view[self.end :]
        self.closed = rest == END_OF_STREAM
        self.torn = len(rest) > 0 and not self.closed
        seals = list(_SEGMENT_SEAL.finditer(rest))
        ends = self.torn and len(rest) > 8 and view[-8:] == END_OF_STREAM
        self.damaged |= ends or (bool(seals) and int(seals[0][1]) <= len(rest))
        self._cut_off = max(int(seals[-1][2]) - self._rows, 0) if seals else 0


def _is_end(view: memoryview, place: int) -> bool:
    rest = len(view) - place
    return rest < 8 or (rest == 8 and view[place:] == END_OF_STREAM)


def _seal_at(view: memoryview, begin: int) -> re.Match[bytes] | None:
    """Return the seal of a message that begins here, or None."""
    if view[begin : begin + 4] != END_OF_STREAM[:4]:
        return None
    size = int.from_bytes(view[begin + 4 : begin + 8], "little", signed=True)
    return (
        _SEGMENT_SEAL.search(view[begin : begin + 8 + size]) if 0 < size <= LARGEST_HEAD else None
    )


def _sealed_message(view: memoryview, begin: int) -> Message | None:
    """Return the message that begins here, if it has a matching seal."""
    seal = _seal_at(view, begin)
    if seal is None:
        return None
    end = begin + int(seal[1])
    whole = end <= len(view) and not is_damaged(view[begin:end])
    return (end, int(seal[2])) if whole else None


def _following(view: memoryview, begin: int) -> tuple[int, Message | None]:
    """Return the beginning of the next intact message, and the message."""
    for match in BEGIN.finditer(view, begin + 1):
        place = match.start()
        found = _sealed_message(view, place) if place % 8 == 0 else None
        if found is not None:
            return place, found
    return begin, None


def _schema(part: pa.Buffer) -> pa.Schema:
    schema = pa.ipc.read_schema(part)
    kept = {k: v for k, v in (schema.metadata or {}).items() if k != SEAL_KEY.encode()}
    return schema.with_metadata(kept or None)


Batches = list[tuple[int, pa.RecordBatch]]
"""The intact batches of a segment, each with its position."""


def read_segment(path: Path) -> tuple[SegmentReader, Batches]:
    """Read a complete segment."""
    reader = SegmentReader()
    with pa.OSFile(str(path)) as opened:
        content = opened.read_buffer()
    return reader, list(reader.batches(content))


def read_log(folder: Path, *, ended: bool = False) -> pa.Table:
    """Return all simulations in a folder of segments, in the order in which they ended.

    A truncated end, written by a killed process, is dropped with a warning. Residuals are null if
    the log omits them.

    Parameters
    ----------
    folder
        `evaluations` of a run folder.
    ended
        Whether the run is finished, so that no segment may be truncated.

    Raises
    ------
    RunFolderError
        If there are no segments, or one is damaged.
    """
    batches: list[pa.RecordBatch] = []
    paths = segments(folder)
    if not paths:
        raise RunFolderError(
            f"{folder}: must contain segments of a log (.arrow), but contains none"
        )
    for path in paths:
        reader, found = read_segment(path)
        reader.check(path, ended=ended)
        batches += [batch for _, batch in found]
        if reader.torn:
            warnings.warn(
                f"{path}: the end of the log was incomplete and has been removed", stacklevel=2
            )
    if not batches:
        return pa.Table.from_batches([], schema=SCHEMA)
    return pa.Table.from_batches(batches)


def repair(path: Path) -> SegmentReader:
    """Remove damaged data from a segment, and return the reader.

    A truncated segment is cut back to its last complete batch, and the stream is ended there. If
    the process is killed during this, no intact data are lost.
    """
    reader, found = read_segment(path)
    if reader.schema is None:
        path.unlink()
    elif reader.damaged:
        _rewrite(path, reader.schema, [batch for _, batch in found])
    else:
        _end_at(path, reader.end)
    return reader


def _end_at(path: Path, end: int) -> None:
    with path.open("r+b") as file:
        file.seek(end)
        if file.read() != END_OF_STREAM:
            file.truncate(end)
            file.seek(end)
            file.write(END_OF_STREAM)
            file.flush()
            os.fsync(file.fileno())


def slim(path: Path) -> None:
    """Rewrite a segment without its large columns, atomically.

    Its batches are joined, because many small batches need more space.
    """
    reader, found = read_segment(path)
    if reader.schema is not None:
        kept = [_without(batch) for _, batch in found]
        table = pa.Table.from_batches(kept, reader.schema).combine_chunks()
        _rewrite(path, reader.schema, table.to_batches(max_chunksize=ROWS_PER_BATCH))


def _rewrite(path: Path, schema: pa.Schema, batches: list[pa.RecordBatch]) -> None:
    partial = path.with_name(f".{path.stem}.slim")
    try:
        with partial.open("wb") as file:
            writer = SegmentWriter(file, schema)
            for batch in batches:
                writer.write(batch)
            writer.close()
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _without(batch: pa.RecordBatch) -> pa.RecordBatch:
    schema = batch.schema
    columns = [
        pa.nulls(batch.num_rows, field.type)
        if field.name in LARGE_LOG_COLUMNS
        else batch.column(field.name)
        for field in schema
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)
