"""Activity of workers and failures of simulations, from the log."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.run_folder.log_segment import SegmentReader, segments
from workers.messages import FloatArray, IntArray, Status


@dataclass
class _KnownSegment:
    """A segment as far as it was read: the file, its reader, and the number of rows read."""

    file: int = 0
    rows: int = 0
    reader: SegmentReader = field(default_factory=SegmentReader)


class LogTail:
    """Reads the complete batches that were added since the last call.

    A truncated end is normal; it is read when it is complete. Nothing is locked or written.

    Parameters
    ----------
    folder
        `evaluations` of a run folder; may be missing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, _KnownSegment] = {}

    def new(self) -> Iterator[pa.RecordBatch]:
        """Yield the new batches, the oldest first.

        Raises
        ------
        RunFolderError
            If a segment is damaged.
        """
        for path in segments(self._folder):
            known = self._known.setdefault(path.name, _KnownSegment())
            try:
                found = path.stat()
                if found.st_size <= known.reader.end and found.st_ino == known.file:
                    continue
                yield from self._read(path, known, found.st_ino)
            except OSError:  # just replaced or removed; the next call reads it
                continue
            known.reader.check(path, ended=False)

    def check_ended(self) -> None:
        """Check that the log of a finished run is not truncated.

        Raises
        ------
        RunFolderError
            If it is truncated.
        """
        for name, known in self._known.items():
            known.reader.check(self._folder / name, ended=True)

    def _read(self, path: Path, known: _KnownSegment, file: int) -> Iterator[pa.RecordBatch]:
        seen = 0
        if file != known.file:  # new, or rewritten without its large columns
            known.file, known.reader, seen = file, SegmentReader(), known.rows
        with pa.memory_map(str(path)) as mapped:
            for _, batch in known.reader.batches(mapped.read_buffer()):
                new = batch.slice(min(seen, batch.num_rows))
                seen -= batch.num_rows - new.num_rows
                known.rows += new.num_rows
                if new.num_rows:
                    yield new


KINDS_OF_FAILURE = 200
BREAK_SECONDS, BREAK_SHARE = 60.0, 0.05
"""A break is longer than this number of seconds, and than this share of the total time."""
NUMBER_IN_MESSAGE = re.compile(r"-?\d+(\.\d+)?(e[-+]?\d+)?")


@dataclass(frozen=True)
class FailureGroup:
    """Simulations that failed with the same message, apart from numbers in it.

    `message` is that of the first simulation, and `first` is its row in the log, for a replay.
    """

    status: str
    message: str
    count: int
    first: int
    experiments: tuple[str, ...]


@dataclass(frozen=True)
class LogActivity:
    """All simulations of a log.

    Attributes
    ----------
    simulations
        Number of simulations.
    workers
        Names of the workers.
    worker : (n,)
        Index of the worker, for each simulation with a known end.
    ended, seconds : (n,)
        Time of the answer, in seconds since 1970, and duration of the simulation.
    failures
        The most frequent failures first.
    """

    simulations: int
    workers: tuple[str, ...]
    worker: IntArray = field(repr=False)
    ended: FloatArray = field(repr=False)
    seconds: FloatArray = field(repr=False)
    failures: tuple[FailureGroup, ...]


class FailureCounts:
    """Counts failures by their messages, batch by batch."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], tuple[int, int, str, dict[str, None]]] = {}
        self.rows = 0
        self.failed = 0

    def add(self, batch: pa.RecordBatch) -> None:
        """Count the rows of a batch of the log."""
        good = pa.array([str(Status.OK), str(Status.ENDED_EARLY)])
        bad = pc.invert(pc.is_in(batch.column("status"), good)).to_numpy(zero_copy_only=False)
        for row in np.flatnonzero(bad).tolist():
            self._note(batch, row)
        self.rows += batch.num_rows
        self.failed += int(bad.sum())

    def _note(self, batch: pa.RecordBatch, row: int) -> None:
        status, message, experiment = (
            batch.column(name)[row].as_py() or "" for name in ("status", "message", "experiment")
        )
        key = status, NUMBER_IN_MESSAGE.sub("", message)
        if key not in self._found and len(self._found) >= KINDS_OF_FAILURE:
            key, message = (status, ""), "others"
        number, first, said, experiments = self._found.get(key, (0, self.rows + row, message, {}))
        self._found[key] = number + 1, first, said, experiments | {experiment: None}

    @property
    def failures(self) -> tuple[FailureGroup, ...]:
        """Groups of failures, the most frequent first."""
        rows = [
            FailureGroup(status, message, number, first, tuple(experiments))
            for (status, _), (number, first, message, experiments) in self._found.items()
        ]
        return tuple(sorted(rows, key=lambda row: (-row.count, row.first)))


def read_activity(folder: Path, *, ended: bool) -> LogActivity:
    """Read the small columns of a log, which may still grow unless its run has `ended`.

    Raises
    ------
    RunFolderError
        If it is damaged.
    """
    tail = ActivityTail(folder)
    tail.read(ended=ended)
    return tail.activity


class ActivityTail:
    """Activity in a log, updated while the log is written; see `LogTail`."""

    def __init__(self, folder: Path) -> None:
        self._tail = LogTail(folder)
        self._names: dict[str, int] = {}
        self._parts: list[tuple[IntArray, FloatArray, FloatArray]] = []
        self.counts = FailureCounts()

    def read(self, *, ended: bool = False) -> None:
        """Read new simulations; if the run has `ended`, the log must not be truncated.

        Raises
        ------
        RunFolderError
            If the log is damaged.
        """
        self._take_in()
        if ended:
            self._take_in()  # a finished run replaces its segments
            self._tail.check_ended()

    def _take_in(self) -> None:
        names = self._names
        for batch in self._tail.new():
            self.counts.add(batch)
            coded = batch.column("worker").dictionary_encode()
            known = [names.setdefault(w, len(names)) for w in coded.dictionary.to_pylist()]
            own = np.array(known, np.int64)[np.asarray(coded.indices)]
            when, seconds = (np.array(batch.column(n)) for n in ("ended", "seconds"))
            self._parts.append((own, when, seconds))

    @property
    def activity(self) -> LogActivity:
        """Activity so far."""
        if len(self._parts) > 1:
            worker, ended, seconds = (np.concatenate(p) for p in zip(*self._parts, strict=True))
            self._parts = [(worker, ended, seconds)]
        nothing = (np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
        worker, ended, seconds = self._parts[0] if self._parts else nothing
        failures = self.counts.failures
        return LogActivity(self.counts.rows, tuple(self._names), worker, ended, seconds, failures)


def without_breaks(activity: LogActivity) -> tuple[LogActivity, float]:
    """Remove long breaks in which no worker was busy, such as the break before a run is resumed.

    Returns
    -------
    Activity, and the seconds that were taken out
    """
    begun = activity.ended - activity.seconds
    order = np.argsort(begun, kind="stable")
    busy_until = np.maximum.accumulate(activity.ended[order])
    idle = np.append(0.0, begun[order][1:] - busy_until[:-1])
    least = max(BREAK_SECONDS, BREAK_SHARE * float(busy_until[-1] - begun.min()))
    removed = np.cumsum(np.where(idle > least, idle, 0.0))
    shift = np.empty_like(removed)
    shift[order] = removed
    return replace(activity, ended=activity.ended - shift), float(removed[-1])


def busy_shares(activity: LogActivity, bins: int) -> tuple[FloatArray, FloatArray]:
    """Return the share of each time interval in which each worker was busy.

    Returns
    -------
    (bins + 1,) seconds since the first simulation began, (workers, bins) shares from 0 to 1
    """
    begun = activity.ended - activity.seconds
    first, last = float(begun.min()), float(activity.ended.max())
    edges = np.linspace(0.0, max(last - first, 1e-9), bins + 1)
    shares = np.zeros((len(activity.workers), bins))
    for number in range(len(activity.workers)):
        own = activity.worker == number
        starts = np.sort(begun[own] - first)
        ends = np.sort(activity.ended[own] - first)
        # the busy time until t is the sum of max(t - start, 0) less that of max(t - end, 0)
        busy = _ramps(starts, edges) - _ramps(ends, edges)
        shares[number] = np.clip(np.diff(busy) / np.diff(edges), 0.0, 1.0)
    return edges, shares


def _ramps(places: FloatArray, edges: FloatArray) -> FloatArray:
    """Return the sum of max(t - place, 0) over all places, at each edge t."""
    sums = np.concatenate([[0.0], np.cumsum(places)])
    below = np.searchsorted(places, edges, side="right")
    return np.asarray(below * edges - sums[below])
