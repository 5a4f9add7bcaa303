"""A segment of an evaluation log: written batch by batch, and read only as far as it checks.

An Arrow IPC stream. Its schema and each of its batches carry, among their metadata, a seal: the
checksum of the whole message, its length, and how many rows there are up to its end. Nothing is
given to Arrow before its checksum agrees, because Arrow believes what a damaged message says, or
crashes.
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
"""`trajectory` is (times, variables), row after row, where that was wanted; `ended` is when its
answer came, in seconds since 1970, `bound` the sum of squares above which it was to end early, null
for none, and `steps` those of the solver, 0 where nobody counts them. `residuals_hash` stays where
residuals have left."""
HASH_LENGTH = 32
"""Characters of a hash of residuals: 128 bits."""
ROWS_PER_BATCH = 2000
"""Rows of a batch in a segment without its large columns."""
LARGE_LOG_COLUMNS = ("residuals", "variables", "times", "trajectory")
"""Columns that can be left out: a resumed run simulates those rows again."""


def logged_cost(outcome: Outcome, want: Want) -> float:
    """The sum of squares of an outcome's residuals, NaN for a failed one.

    That of absolute values where only this is known.
    """
    if outcome.residuals is None:
        return np.nan
    with np.errstate(over="ignore"):  # it may be infinite
        sizes = outcome.residuals if want == "absolutes" else outcome.residuals**2
        return float(np.add.reduce(sizes))


def residuals_hash(residuals: FloatArray | None) -> str | None:
    """The hash of residuals bit for bit, by which they are known when they are there no more."""
    return None if residuals is None else content_hash([residuals.tobytes()])[:HASH_LENGTH]


END_OF_STREAM = b"\xff\xff\xff\xff\x00\x00\x00\x00"
BEGIN = re.compile(rb"(?=\xff\xff\xff\xff)")
"""The begin of a message, which is at a multiple of 8 bytes."""
LARGEST_HEAD = 2**20
Message = tuple[int, int]
"""The end of a message, and the rows of the segment up to there."""
_SEGMENT_SEAL = re.compile(rb"cluster-est crc32:[0-9a-f]{8} bytes:(\d{12}) rows:(\d{12})")
_INVALID = (pa.ArrowException, OSError, EOFError, ValueError, KeyError, MemoryError)
"""What reading a damaged message raises."""


def segments(folder: Path) -> list[Path]:
    """The segments of a log, the oldest first."""
    return sorted(folder.glob("*.arrows"))


class SegmentWriter:
    """Appends sealed batches to a file.

    Parameters
    ----------
    file
        Empty.
    schema
        Of the batches.
    """

    def __init__(self, file: BinaryIO, schema: pa.Schema) -> None:
        self._file, self._rows = file, 0
        self._schema = schema.with_metadata({**(schema.metadata or {}), SEAL_KEY: _seal(0, 0)})
        head = self._schema.serialize().to_pybytes()
        self._head = len(head)
        file.write(_filled(head, 0))

    def write(self, batch: pa.RecordBatch) -> None:
        """Append a batch, in one piece."""
        self._rows += batch.num_rows
        stream = io.BytesIO()
        writer = pa.ipc.new_stream(stream, self._schema)
        batch = batch.replace_schema_metadata(self._schema.metadata)
        writer.write_batch(batch, custom_metadata={SEAL_KEY: _seal(0, self._rows)})
        self._file.write(_filled(stream.getvalue()[self._head :], self._rows))

    def close(self) -> None:
        """End the stream, not the file."""
        self._file.write(END_OF_STREAM)


def _seal(size: int, rows: int) -> str:
    return f"{SEAL} bytes:{size:012d} rows:{rows:012d}"


def _filled(message: bytes, rows: int) -> bytes:
    seal = _seal(len(message), rows).encode()
    return sealed(message.replace(_seal(0, rows).encode(), seal, 1))


class SegmentReader:
    """Gives what is as it was written; asked again, it goes on where the segment has grown.

    Attributes
    ----------
    end
        Where the last message ends that was believed; 0 before the schema.
    schema
        None before it was read, and where it is damaged.
    lost
        Rows that are known to be there and cannot be believed.
    damaged
        Whether there is anything that is neither as it was written nor merely cut off.
    torn
        Whether something follows that last message.
    closed
        Whether only the end of the stream follows: nobody will go on with it.
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
        """Each batch that was not given yet, with its position in all that the segment holds.

        What is damaged is passed over, and a torn end left: the rest of it may still come.
        """
        view = memoryview(content).cast("B")  # of Arrow, it is of signed bytes
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
        """Refuse a segment of which something was passed over, or torn although its run has ended.

        Raises
        ------
        RunFolderError
            If that is so.
        """
        if self.damaged or (ended and not self.closed):
            what = (
                f"{self.lost} of its simulations have" if self.lost else "a part of its content has"
            )
            raise RunFolderError(
                f"{path}: the file is damaged: {what} changed since it was written; {MEND}"
            )

    def _parsed(self, part: pa.Buffer, rows: int, *, first: bool) -> pa.RecordBatch | None:
        """The batch in a message; None for the schema, and for what is not valid."""
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
        """Judge what follows the last message: nothing, what was cut off, or what is damaged."""
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
    """The seal of a message that begins here, if there is one."""
    if view[begin : begin + 4] != END_OF_STREAM[:4]:
        return None
    size = int.from_bytes(view[begin + 4 : begin + 8], "little", signed=True)
    return (
        _SEGMENT_SEAL.search(view[begin : begin + 8 + size]) if 0 < size <= LARGEST_HEAD else None
    )


def _sealed_message(view: memoryview, begin: int) -> Message | None:
    """The message that begins here, if there is one with a seal and it agrees with it."""
    seal = _seal_at(view, begin)
    if seal is None:
        return None
    end = begin + int(seal[1])
    whole = end <= len(view) and not is_damaged(view[begin:end])
    return (end, int(seal[2])) if whole else None


def _following(view: memoryview, begin: int) -> tuple[int, Message | None]:
    """Where the next message begins that agrees with its seal, and the message."""
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
"""The batches of a segment that are as they were written, each with where it begins."""


def read_segment(path: Path) -> tuple[SegmentReader, Batches]:
    """Go through a whole segment."""
    reader = SegmentReader()
    with pa.OSFile(str(path)) as opened:
        content = opened.read_buffer()
    return reader, list(reader.batches(content))


def read_log(folder: Path, *, ended: bool = False) -> pa.Table:
    """All simulations in a folder of segments, in the order in which they ended.

    A torn end, left by a process that was killed while writing, is dropped with a warning. Where
    the log was told to leave residuals out, they are null.

    Parameters
    ----------
    folder
        `evaluations` of a run folder.
    ended
        Whether the run has reached its end, so that nothing may be torn.

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
    """Leave of a segment what is as it was written, and return what was found.

    A torn segment is cut back to its last whole batch, and ended there. A kill in the middle of
    this loses nothing: only what cannot be believed goes.
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
    """Rewrite a segment without its large columns, in one step.

    Its batches are joined: many that were written as they came take more room than their rows.
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
