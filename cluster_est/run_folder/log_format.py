"""The format of an evaluation log's segments, and how they are read and mended."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
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
    ]
)
"""`trajectory` is (times, variables), row after row, where that was wanted; `ended` is when its
answer came, in seconds since 1970, `bound` the sum of squares above which it was to end early, null
for none. `ended`, `bound` and `residuals_hash`, which stays where residuals have left, are missing
in logs of versions that did not keep them."""
HASH_LENGTH = 32
"""Characters of a hash of residuals: 128 bits."""
ROWS_PER_BATCH = 2000
"""Of a segment without its large columns."""
LARGE = ("residuals", "variables", "times", "trajectory")
"""Columns that can be left out: a resumed run simulates those rows again."""
END_OF_STREAM = b"\xff\xff\xff\xff\x00\x00\x00\x00"


def logged_cost(outcome: Outcome, want: Want) -> float:
    """The sum of squares of an outcome's residuals, NaN where there are none.

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


def segments(folder: Path) -> list[Path]:
    """The segments of a log, the oldest first."""
    return sorted(folder.glob("*.arrows"))


def read_batches(
    opened: pa.NativeFile, visit: Callable[[int, pa.RecordBatch], None]
) -> tuple[int, str]:
    """Go through the whole batches of a segment.

    Parameters
    ----------
    opened
        The segment.
    visit
        Called with the position at which a batch begins, and the batch.

    Returns
    -------
    tuple of int and str
        Where the last whole batch ends, 0 if there is not even a schema; and what is wrong with
        what follows, empty if nothing is.
    """
    end = 0
    try:
        with pa.ipc.open_stream(opened) as reader:
            end = opened.tell()
            for batch in reader:
                visit(end, batch)
                end = opened.tell()
    except (pa.ArrowInvalid, OSError) as error:
        return end, str(error)
    return end, ""


def mend(path: Path) -> None:
    """Cut a torn segment back to its last whole batch, and end it there.

    A kill in the middle of this loses nothing: only what cannot be read is cut off.
    """
    with pa.OSFile(str(path)) as opened:
        end, _ = read_batches(opened, lambda *_: None)
    if end == 0:
        path.unlink()
        return
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
    partial = path.with_name(f".{path.stem}.slim")
    with pa.OSFile(str(path)) as opened, pa.ipc.open_stream(opened) as reader:
        schema = reader.schema
        kept = pa.Table.from_batches([_without(batch, schema) for batch in reader], schema)
    try:
        with partial.open("wb") as file:
            with pa.ipc.new_stream(file, schema) as writer:
                writer.write_table(kept.combine_chunks(), max_chunksize=ROWS_PER_BATCH)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _without(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    columns = [
        pa.nulls(batch.num_rows, field.type) if field.name in LARGE else batch.column(field.name)
        for field in schema
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def read_log(folder: Path) -> pa.Table:
    """All simulations in a folder of segments, in the order in which they ended.

    A torn end, left by a process that was killed while writing, is dropped with a warning. Where
    the log was told to leave residuals out, they are null.

    Raises
    ------
    RunFolderError
        If there are no segments.
    """
    batches: list[pa.RecordBatch] = []
    paths = segments(folder)
    if not paths:
        raise RunFolderError(f"{folder}: must hold evaluation segments but holds none")
    for path in paths:
        with pa.OSFile(str(path)) as opened:
            _, wrong = read_batches(opened, lambda _, batch: batches.append(batch))
        if wrong:
            warnings.warn(f"{path}: its torn end was dropped ({wrong})", stacklevel=2)
    if not batches:
        return pa.Table.from_batches([], schema=SCHEMA)
    tables = [pa.Table.from_batches([batch]) for batch in batches]
    return pa.concat_tables(tables, promote_options="default")  # segments may be older than others
