"""The evaluation log: every simulation, written during the run.

It consists of numbered segments, which are Arrow IPC streams. Written data survive the end of this
process, and synced data survive a crash of the machine. A segment that was cut off during a write
is read up to that point.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa

from cluster_est.errors import UnwritableError
from cluster_est.executors.log_replay import simulation_key
from cluster_est.run_folder.log_segment import (
    SCHEMA,
    SegmentWriter,
    logged_cost,
    residuals_hash,
    segments,
    slim,
)
from cluster_est.running.resources import LogSettings, TaskOrigin
from cluster_est.whole_files import MAKE_ROOM_AND_RESUME, writing
from workers.messages import FloatArray, Outcome, Trajectory


class LogRow(NamedTuple):
    """A simulation, and the time of its answer, in seconds since 1970."""

    origin: TaskOrigin
    outcome: Outcome
    ended: float


def batch_of(
    rows: Sequence[LogRow],
    model_key: str,
    experiments: Sequence[tuple[str, str]],
    *,
    residuals: bool,
) -> pa.RecordBatch:
    """Return the columns of the log for some simulations.

    Parameters
    ----------
    rows
        In the order in which the simulations ended.
    model_key
        First part of each row's key.
    experiments
        (id, key) of each experiment, by index.
    residuals
        Whether to include residuals and trajectories.
    """
    origins, outcomes, ended = zip(*rows, strict=True)
    whole = [residuals and not origin.slim for origin in origins]
    pairs = list(zip(outcomes, whole, strict=True))
    paths = [outcome.trajectory if kept else None for outcome, kept in pairs]
    names = [origin.installed or experiments[origin.task.experiment] for origin in origins]
    keys = [
        simulation_key(model_key, key, task.effects, task.values, task.bound, task.step_limit)
        for task, (_, key) in zip([origin.task for origin in origins], names, strict=True)
    ]
    columns = [
        pa.array(keys),
        pa.array([origin.task.want for origin in origins]),
        pa.array([origin.search for origin in origins]),
        pa.array([origin.evaluation for origin in origins], pa.int64()),
        pa.array([origin.purpose for origin in origins]),
        pa.array([name for name, _ in names]),
        _lists([origin.task.values for origin in origins]),
        pa.array([[effect.name for effect in origin.task.effects] for origin in origins]),
        pa.array([str(outcome.status) for outcome in outcomes]),
        pa.array([outcome.message for outcome in outcomes]),
        pa.array([logged_cost(row.outcome, row.origin.task.want) for row in rows], pa.float64()),
        _lists([outcome.residuals if kept else None for outcome, kept in pairs]),
        pa.array([residuals_hash(outcome.residuals) for outcome in outcomes], pa.string()),
        _lists([outcome.constraints if outcome.ok else None for outcome in outcomes]),
        pa.array([outcome.seconds for outcome in outcomes], pa.float64()),
        pa.array([outcome.worker for outcome in outcomes]),
        pa.array([path and list(path.variables) for path in paths], pa.list_(pa.string())),
        _lists([path and path.times for path in paths]),
        _lists([path and path.values.ravel() for path in paths]),
        pa.array(ended, pa.float64()),
        pa.array([_finite(origin.task.bound) for origin in origins], pa.float64()),
        pa.array([outcome.steps for outcome in outcomes], pa.int64()),
    ]
    return pa.RecordBatch.from_arrays(columns, schema=SCHEMA)


def size_of(outcome: Outcome) -> int:
    """Return the bytes of the large arrays of an outcome."""
    size = 0 if outcome.residuals is None else outcome.residuals.nbytes
    path: Trajectory | None = outcome.trajectory
    return size + (0 if path is None else path.times.nbytes + path.values.nbytes)


def _finite(bound: float) -> float | None:
    return bound if np.isfinite(bound) else None


def _lists(rows: Sequence[FloatArray | None]) -> pa.Array:
    lengths = [0 if row is None else len(row) for row in rows]
    flat = [row for row in rows if row is not None]
    ends = np.cumsum([0, *lengths]).astype(np.int32)
    missing = pa.array([row is None for row in rows])
    values = np.concatenate(flat) if flat else np.zeros(0)
    return pa.ListArray.from_arrays(pa.array(ends), pa.array(values), mask=missing)


ROWS_PER_WRITE, SECONDS_PER_WRITE, SECONDS_PER_SYNC = 2000, 0.25, 1.0
BYTES_PER_WRITE, BYTES_PER_SEGMENT = 16 * 2**20, 256 * 2**20
SEGMENTS_AT_LEAST = 8
"""Smallest number of segments of a bounded log, because complete segments lose their residuals."""


class EvaluationLog:
    """Appends simulations to the segments in a folder.

    Parameters
    ----------
    folder
        `evaluations` in a run folder, to which no other process writes; created if missing.
    model_key
        Hash of model, interface and solver, the first part of each row's key.
    experiments
        (id, key) of each experiment, by index.
    metadata
        Metadata of the schema of each segment.
    settings
        Amount of data to keep.
    first_segment
        Number of the first segment to write; the log of a resumed run follows the existing
        segments.
    say
        Called once, with a sentence, when the log has reached its maximum size.
    """

    def __init__(
        self,
        folder: Path,
        model_key: str,
        experiments: list[tuple[str, str]],
        metadata: dict[str, str],
        settings: LogSettings | None = None,
        first_segment: int = 0,
        *,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self._folder = folder
        self._model_key = model_key
        self._experiments = experiments
        self._schema = SCHEMA.with_metadata(metadata)
        self._settings = settings or LogSettings()
        self._say = say or (lambda _: None)
        self._rows: list[LogRow] = []
        self._bytes = 0
        self._written = self._synced = 0.0
        self._segment = first_segment
        self._slim: set[str] = set()
        self._is_full = self._stays_large = False
        self._stream: tuple[BinaryIO, SegmentWriter] | None = None
        self._adding, self._writing = threading.Lock(), threading.Lock()
        self._ended = threading.Event()
        self._writer: threading.Thread | None = None
        self._failure: UnwritableError | None = None
        folder.mkdir(parents=True, exist_ok=True)

    def record(self, origin: TaskOrigin, outcome: Outcome) -> None:
        """Add one simulation, which is written soon afterwards.

        Raises
        ------
        UnwritableError
            If the log cannot be written.
        """
        if self._failure is not None:
            raise self._failure
        with self._adding:
            self._rows.append(LogRow(origin, outcome, time.time()))
            self._bytes += 200 + size_of(outcome)
            late = time.monotonic() - self._written > SECONDS_PER_WRITE
            full = len(self._rows) >= ROWS_PER_WRITE or self._bytes >= BYTES_PER_WRITE
        if late or full:
            self.flush()
        if self._writer is None:
            self._writer = threading.Thread(target=self._write_late, daemon=True)
            self._writer.start()

    def flush(self) -> None:
        """Write the recorded simulations, and sync the file once a second."""
        try:
            with writing(self._folder, MAKE_ROOM_AND_RESUME):
                self._flush()
        except UnwritableError as error:
            self._failure = error
            self._drop_stream()
            raise

    def _flush(self) -> None:
        with self._writing:
            with self._adding:
                rows, self._rows, self._bytes = self._rows, [], 0
                self._written = time.monotonic()
            if not rows:
                return
            file, writer = self._open()
            batch = batch_of(
                rows, self._model_key, self._experiments, residuals=self._settings.residuals
            )
            writer.write(batch)
            file.flush()
            if time.monotonic() - self._synced > SECONDS_PER_SYNC:
                os.fsync(file.fileno())
                self._synced = time.monotonic()
            if file.tell() >= self._segment_bytes:
                self._end_segment()

    def close(self) -> None:
        """Write the remaining simulations and end the segment.

        Raises
        ------
        UnwritableError
            If the log cannot be written, now or before.
        """
        self._ended.set()
        if self._writer is not None:
            self._writer.join()
        if self._failure is not None:
            raise self._failure
        self.flush()
        with self._writing, writing(self._folder, MAKE_ROOM_AND_RESUME):
            self._end_segment()

    def let_residuals_go(self) -> None:
        """Remove residuals and trajectories from the closed log of a finished run.

        They are not removed if the settings keep them. Their hashes remain, so a later simulation
        with the same values can be compared.
        """
        if self._settings.keep_residuals or not self._settings.residuals:
            return
        for path in segments(self._folder):
            if path.name not in self._slim and not self._slim_one(path):
                return

    def _write_late(self) -> None:
        """Write recorded simulations while the run waits for long simulations."""
        while not self._ended.wait(min(max(SECONDS_PER_WRITE, 0.01), threading.TIMEOUT_MAX)):
            try:
                self.flush()
            except UnwritableError:  # the next call of `record` raises it
                return

    @property
    def _limit(self) -> float:
        """Largest size of all segments together, in bytes."""
        return self._settings.max_megabytes * 2**20 or np.inf

    @property
    def _segment_bytes(self) -> float:
        return min(BYTES_PER_SEGMENT, self._limit / SEGMENTS_AT_LEAST)

    def _open(self) -> tuple[BinaryIO, SegmentWriter]:
        if self._stream is None:
            file = (self._folder / f"{self._segment:05d}.arrows").open("xb")
            self._segment += 1
            self._stream = file, SegmentWriter(file, self._schema)
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

    def _drop_stream(self) -> None:
        """Close a segment that cannot be written any more."""
        with self._writing:
            stream, self._stream = self._stream, None
        if stream is not None:
            with suppress(OSError):
                stream[0].close()

    def _shrink(self) -> None:
        """Remove residuals and trajectories from the oldest segments until the limit is met."""
        paths = segments(self._folder)
        total = sum(path.stat().st_size for path in paths)
        for path in paths:
            if total <= self._limit:
                return
            if path.name not in self._slim:
                if not self._is_full:
                    self._is_full = True
                    self._say(
                        f"the log has reached {self._settings.max_megabytes:g} MB "
                        "(log.max_megabytes): from now on, the oldest residuals and trajectories "
                        "are removed; a resumed run repeats these simulations"
                    )
                total -= path.stat().st_size
                if not self._slim_one(path):
                    return
                total += path.stat().st_size

    def _slim_one(self, path: Path) -> bool:
        """Remove the large columns of a segment; if this fails, the run continues."""
        try:
            slim(path)
        except OSError as error:
            if not self._stays_large:
                self._say(
                    f"{self._folder}: residuals cannot be removed from the log ({error}), so "
                    "the log stays large"
                )
            self._stays_large = True
            return False
        self._slim.add(path.name)
        return True
