"""The evaluation log: every simulation, written while the run goes on.

Arrow IPC streams in numbered segments. What was written survives the death of this process, what
was synced survives a crash of the machine; a segment that was cut off in the middle of a write is
read up to there.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.executors.simulation_key import simulation_key
from cluster_est.run_folder.lock import lock
from cluster_est.run_folder.log_format import (
    SCHEMA,
    logged_cost,
    read_log,
    segments,
    slim,
)
from cluster_est.running.records import TaskOrigin
from workers.messages import Outcome, Trajectory

__all__ = ["SCHEMA", "EvaluationLog", "LogSettings", "read_log"]

ROWS_PER_WRITE, SECONDS_PER_WRITE, SECONDS_PER_SYNC = 2000, 0.25, 1.0
BYTES_PER_WRITE, BYTES_PER_SEGMENT = 16 * 2**20, 256 * 2**20
SEGMENTS_AT_LEAST = 8
"""Into how many the room of a bounded log is cut, because whole segments lose their residuals."""


@dataclass(frozen=True)
class LogSettings:
    """The share of each simulation that is kept.

    What is left out is simulated again when the run is resumed, and changes no bit of it.

    Attributes
    ----------
    residuals
        Whether residuals and trajectories are written.
    megabytes
        When all segments together are larger, the oldest lose theirs; 0 for never. About 300 bytes
        of each simulation always stay.
    """

    residuals: bool = True
    megabytes: float = 4096.0


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
    settings
        How much is kept.
    first_segment
        Number of the first one that is written; a resumed run's log goes on behind the others.

    Raises
    ------
    RunFolderError
        If another process writes a log there.
    """

    def __init__(
        self,
        folder: Path,
        model_key: str,
        experiments: list[tuple[str, str]],
        metadata: dict[str, str],
        settings: LogSettings | None = None,
        first_segment: int = 0,
    ) -> None:
        self._folder = folder
        self._model_key = model_key
        self._experiments = experiments
        self._schema = SCHEMA.with_metadata(metadata)
        self._settings = settings or LogSettings()
        self._rows: list[tuple[TaskOrigin, Outcome, float]] = []
        self._bytes = 0
        self._written = self._synced = 0.0
        self._segment = first_segment
        self._slim: set[str] = set()
        self._stream: tuple[BinaryIO, pa.ipc.RecordBatchStreamWriter] | None = None
        self._adding, self._writing = threading.Lock(), threading.Lock()
        self._ended = threading.Event()
        self._writer: threading.Thread | None = None
        self._failure: RunFolderError | None = None
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = lock(folder)

    def record(self, origin: TaskOrigin, outcome: Outcome) -> None:
        """Add one simulation; a moment later it is safe from the end of this process.

        Raises
        ------
        RunFolderError
            If the log cannot be written.
        """
        if self._failure is not None:
            raise self._failure
        with self._adding:
            self._rows.append((origin, outcome, time.time()))
            self._bytes += 200 + _size(outcome)
            late = time.monotonic() - self._written > SECONDS_PER_WRITE
            full = len(self._rows) >= ROWS_PER_WRITE or self._bytes >= BYTES_PER_WRITE
        if late or full:
            self.flush()
        if self._writer is None:
            self._writer = threading.Thread(target=self._write_late, daemon=True)
            self._writer.start()

    def flush(self) -> None:
        """Write what has been recorded, and sync it once a second."""
        try:
            self._flush()
        except OSError as error:
            raise RunFolderError(
                f"{self._folder}: must be written but cannot be ({error}); make room, and go on "
                "with --resume"
            ) from error

    def _flush(self) -> None:
        with self._writing:
            with self._adding:
                rows, self._rows, self._bytes = self._rows, [], 0
                self._written = time.monotonic()
            if not rows:
                return
            file, writer = self._open()
            writer.write_batch(self._batch(rows))
            file.flush()
            if time.monotonic() - self._synced > SECONDS_PER_SYNC:
                os.fsync(file.fileno())
                self._synced = time.monotonic()
            if file.tell() >= self._segment_bytes:
                self._end_segment()

    def close(self) -> None:
        """Write what is left and end the segment."""
        self._ended.set()
        if self._writer is not None:
            self._writer.join()
        self.flush()
        with self._writing:
            self._end_segment()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _write_late(self) -> None:
        """Write what was recorded while the run now waits for simulations that take long."""
        while not self._ended.wait(min(max(SECONDS_PER_WRITE, 0.01), threading.TIMEOUT_MAX)):
            try:
                self.flush()
            except RunFolderError as error:
                self._failure = error
                return

    @property
    def _limit(self) -> float:
        """Bytes of all segments together."""
        return self._settings.megabytes * 2**20 or np.inf

    @property
    def _segment_bytes(self) -> float:
        return min(BYTES_PER_SEGMENT, self._limit / SEGMENTS_AT_LEAST)

    def _open(self) -> tuple[BinaryIO, pa.ipc.RecordBatchStreamWriter]:
        if self._stream is None:
            file = (self._folder / f"{self._segment:05d}.arrows").open("xb")
            self._segment += 1
            self._stream = file, pa.ipc.new_stream(file, self._schema)
        return self._stream

    def _end_segment(self) -> None:
        if self._stream is not None:
            file, writer = self._stream
            writer.close()
            file.flush()
            os.fsync(file.fileno())
            file.close()
            self._stream = None
            self._shrink()

    def _shrink(self) -> None:
        """Keep to the limit: take residuals and trajectories from the oldest segments."""
        paths = segments(self._folder)
        total = sum(path.stat().st_size for path in paths)
        for path in paths:
            if total <= self._limit:
                return
            if path.name not in self._slim:
                total -= path.stat().st_size
                slim(path)
                total += path.stat().st_size
                self._slim.add(path.name)

    def _batch(self, rows: list[tuple[TaskOrigin, Outcome, float]]) -> pa.RecordBatch:
        origins, outcomes, ended = zip(*rows, strict=True)
        kept = self._settings.residuals
        paths = [outcome.trajectory if kept else None for outcome in outcomes]
        names = [origin.installed or self._experiments[origin.experiment] for origin in origins]
        keys = [
            simulation_key(self._model_key, key, origin.effects, origin.values)
            for origin, (_, key) in zip(origins, names, strict=True)
        ]
        columns = [
            pa.array(keys),
            pa.array([origin.want for origin in origins]),
            pa.array([origin.search for origin in origins]),
            pa.array([origin.evaluation for origin in origins], pa.int64()),
            pa.array([origin.purpose for origin in origins]),
            pa.array([name for name, _ in names]),
            _lists([origin.values for origin in origins]),
            pa.array([[effect.name for effect in origin.effects] for origin in origins]),
            pa.array([str(outcome.status) for outcome in outcomes]),
            pa.array([outcome.message for outcome in outcomes]),
            pa.array([logged_cost(each, origin.want) for origin, each, _ in rows], pa.float64()),
            _lists([outcome.residuals if kept else None for outcome in outcomes]),
            _lists([outcome.constraints if outcome.ok else None for outcome in outcomes]),
            pa.array([outcome.seconds for outcome in outcomes], pa.float64()),
            pa.array([outcome.worker for outcome in outcomes]),
            pa.array([path and list(path.variables) for path in paths], pa.list_(pa.string())),
            _lists([path and path.times for path in paths]),
            _lists([path and path.values.ravel() for path in paths]),
            pa.array(ended, pa.float64()),
        ]
        return pa.RecordBatch.from_arrays(columns, schema=self._schema)


def _size(outcome: Outcome) -> int:
    size = 0 if outcome.residuals is None else outcome.residuals.nbytes
    path: Trajectory | None = outcome.trajectory
    return size + (0 if path is None else path.times.nbytes + path.values.nbytes)


def _lists(rows: list[np.ndarray | None]) -> pa.Array:
    lengths = [0 if row is None else len(row) for row in rows]
    flat = [row for row in rows if row is not None]
    ends = np.cumsum([0, *lengths]).astype(np.int32)
    missing = pa.array([row is None for row in rows])
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(pa.array(ends), pa.array(values), mask=missing)
