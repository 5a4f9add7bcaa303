"""The evaluation log: every simulation, written while the run goes on.

Arrow IPC streams in numbered segments. What was synced survives a crash of the machine; a segment
that was cut off in the middle of a write is read up to there.
"""

from __future__ import annotations

import os
import time
import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.runner import Origin
from workers.messages import Outcome, content_hash

SCHEMA = pa.schema(
    [
        ("key", pa.string()),
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
        ("constraints", pa.list_(pa.float64())),
        ("seconds", pa.float64()),
        ("worker", pa.string()),
    ]
)
ROWS_PER_WRITE, SECONDS_PER_WRITE = 2000, 1.0
BYTES_PER_WRITE, BYTES_PER_SEGMENT = 16 * 2**20, 256 * 2**20


class EvaluationLog:
    """Appends simulations to the segments in a folder.

    Parameters
    ----------
    folder
        `evaluations` in a run folder; made if it is not there.
    model_key
        Hash of model, interface and solver, the first part of each row's key.
    experiments
        (id, key) of each experiment, by index.
    metadata
        Written into the schema of each segment.
    """

    def __init__(
        self,
        folder: Path,
        model_key: str,
        experiments: list[tuple[str, str]],
        metadata: dict[str, str],
    ) -> None:
        self._folder = folder
        self._model_key = model_key
        self._experiments = experiments
        self._schema = SCHEMA.with_metadata(metadata)
        self._rows: list[tuple[Origin, Outcome]] = []
        self._bytes = 0
        self._written = 0.0
        self._segment = 0
        self._stream: tuple[BinaryIO, pa.ipc.RecordBatchStreamWriter] | None = None
        folder.mkdir(parents=True, exist_ok=True)

    def record(self, origin: Origin, outcome: Outcome) -> None:
        """Add one simulation; it reaches the disk within about a second."""
        self._rows.append((origin, outcome))
        self._bytes += 200 + (0 if outcome.residuals is None else outcome.residuals.nbytes)
        late = time.monotonic() - self._written > SECONDS_PER_WRITE
        if late or len(self._rows) >= ROWS_PER_WRITE or self._bytes >= BYTES_PER_WRITE:
            self.flush()

    def flush(self) -> None:
        """Write and sync what has been recorded."""
        self._written = time.monotonic()
        if not self._rows:
            return
        file, writer = self._open()
        writer.write_batch(self._batch())
        self._rows, self._bytes = [], 0
        file.flush()
        os.fsync(file.fileno())
        if file.tell() >= BYTES_PER_SEGMENT:
            self._end_segment()

    def close(self) -> None:
        """Write what is left and end the segment."""
        self.flush()
        self._end_segment()

    def _open(self) -> tuple[BinaryIO, pa.ipc.RecordBatchStreamWriter]:
        if self._stream is None:
            file = (self._folder / f"{self._segment:05d}.arrows").open("wb")
            self._segment += 1
            self._stream = file, pa.ipc.new_stream(file, self._schema)
        return self._stream

    def _end_segment(self) -> None:
        if self._stream is not None:
            file, writer = self._stream
            writer.close()
            file.close()
            self._stream = None

    def _batch(self) -> pa.RecordBatch:
        origins, outcomes = zip(*self._rows, strict=True)
        with np.errstate(over="ignore"):  # a cost may be infinite
            sums = [
                np.nan if o.residuals is None else float(np.add.reduce(o.residuals**2))
                for o in outcomes
            ]
        names = [origin.installed or self._experiments[origin.experiment] for origin in origins]
        keys = [
            content_hash([self._model_key, key, repr(origin.effects), origin.values.tobytes()])
            for origin, (_, key) in zip(origins, names, strict=True)
        ]
        columns = [
            pa.array(keys),
            pa.array([origin.search for origin in origins]),
            pa.array([origin.evaluation for origin in origins], pa.int64()),
            pa.array([origin.purpose for origin in origins]),
            pa.array([name for name, _ in names]),
            _lists([origin.values for origin in origins]),
            pa.array([[effect.name for effect in origin.effects] for origin in origins]),
            pa.array([str(outcome.status) for outcome in outcomes]),
            pa.array([outcome.message for outcome in outcomes]),
            pa.array(sums, pa.float64()),
            _lists([outcome.residuals for outcome in outcomes]),
            _lists([outcome.constraints if outcome.ok else None for outcome in outcomes]),
            pa.array([outcome.seconds for outcome in outcomes], pa.float64()),
            pa.array([outcome.worker for outcome in outcomes]),
        ]
        return pa.RecordBatch.from_arrays(columns, schema=self._schema)


def _lists(rows: list[np.ndarray | None]) -> pa.Array:
    lengths = [0 if row is None else len(row) for row in rows]
    flat = [row for row in rows if row is not None]
    ends = np.cumsum([0, *lengths]).astype(np.int32)
    missing = pa.array([row is None for row in rows])
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(pa.array(ends), pa.array(values), mask=missing)


def read_log(folder: Path) -> pa.Table:
    """All simulations in a folder of segments, in the order in which they ended.

    A torn end, left by a process that was killed while writing, is dropped with a warning.

    Raises
    ------
    RunFolderError
        If there are no segments.
    """
    batches: list[pa.RecordBatch] = []
    paths = sorted(folder.glob("*.arrows"))
    if not paths:
        raise RunFolderError(f"{folder}: must hold evaluation segments but holds none")
    for path in paths:
        try:
            with pa.OSFile(str(path)) as opened, pa.ipc.open_stream(opened) as reader:
                for batch in reader:
                    batches.append(batch)  # noqa: PERF402 - those before a torn end are kept
        except (pa.ArrowInvalid, OSError) as error:
            warnings.warn(f"{path}: its torn end was dropped ({error})", stacklevel=2)
    return pa.Table.from_batches(batches, schema=batches[0].schema if batches else SCHEMA)
