"""Outcomes in a log, which replace simulations when an interrupted run is repeated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.executors.executor import OutcomeSource
from cluster_est.run_folder.log_segment import read_segment, repair, residuals_hash, segments
from workers.messages import USUAL, FloatArray, IntArray, Outcome, Status, Trajectory, Want

KEY_LENGTH = 32
"""Number of characters of a key that are kept in memory: 128 bits."""


class LoggedOutcomes(OutcomeSource):
    """The rows of a log, found by key and kind of answer; each is used once.

    Truncated and damaged segments are repaired first, so that only intact data remain. Keys are
    kept in memory, about 100 bytes a row. Other columns are read from the mapped segments when
    needed.

    Parameters
    ----------
    folder
        `evaluations` of a run folder, to which no other process writes; may be missing.

    Attributes
    ----------
    next_segment
        Number of the next segment of the log.
    remaining
        Number of unused rows.
    damaged
        Whether a part of the log was damaged and has been removed.
    lost
        Number of rows that are known to be lost.
    differing
        Number of rows whose repeated simulation gave other residuals.
    """

    def __init__(self, folder: Path) -> None:
        corrected = [repair(path) for path in segments(folder)]
        self.damaged = any(each.damaged for each in corrected)
        self.lost = sum(each.lost for each in corrected)
        paths = segments(folder)
        self._segments = [pa.memory_map(str(path)) for path in paths]
        self._batches: list[tuple[int, int]] = []  # segment, position
        self._schemas: dict[int, pa.Schema] = {}
        begins, keys, whole = [0], [np.zeros(0, f"S{KEY_LENGTH + 2}")], [np.zeros(0, bool)]
        for number, path in enumerate(paths):
            for position, batch in read_segment(path)[1]:
                self._schemas.setdefault(number, batch.schema)
                self._batches.append((number, position))
                begins.append(begins[-1] + batch.num_rows)
                keys.append(_keys(batch))
                whole.append(_whole(batch))
        self._begins = np.array(begins)
        self._whole: IntArray = np.concatenate(whole)
        found: IntArray = np.concatenate(keys)
        self._order = np.argsort(found, kind="stable")
        self._keys = found[self._order]
        self._taken = np.zeros(len(found), bool)
        self._read: tuple[int, pa.RecordBatch | None] = (-1, None)
        self._answered: set[int] = set()
        self.next_segment = int(paths[-1].stem) + 1 if paths else 0
        self.remaining = len(found)
        self.differing = 0

    def __len__(self) -> int:
        return len(self._order)

    def take(self, questions: Sequence[tuple[str, Want]]) -> list[int | None]:
        """Return the first unused row for each key and kind of answer, None if there is none."""
        asked = np.array([_short(key, want) for key, want in questions], self._keys.dtype)
        places = np.searchsorted(self._keys, asked)
        return [self._take(key, place) for key, place in zip(asked, places.tolist(), strict=True)]

    def _take(self, key: bytes, place: int) -> int | None:
        while place < len(self._keys) and self._keys[place] == key:
            row = int(self._order[place])
            if not self._taken[row]:
                self._taken[row] = True
                self.remaining -= 1
                return row
            place += 1
        return None

    def is_whole(self, row: int) -> bool:
        """Return whether the log contains a complete outcome, so no simulation is needed."""
        return bool(self._whole[row])

    def outcome(self, row: int, task: int) -> Outcome:
        """Return the outcome in a row, as the answer to a task."""
        number = int(np.searchsorted(self._begins, row, side="right")) - 1
        batch, i = self._batch(number), row - int(self._begins[number])
        constraints = _floats(batch, "constraints", i)
        return Outcome(
            task,
            Status(batch.column("status")[i].as_py()),
            _floats(batch, "residuals", i),
            _trajectory(batch, i),
            batch.column("message")[i].as_py(),
            batch.column("seconds")[i].as_py(),
            batch.column("worker")[i].as_py(),
            constraints=np.zeros(0) if constraints is None else constraints,
            steps=batch.column("steps")[i].as_py(),
        )

    def compare(self, row: int, outcome: Outcome) -> None:
        """Compare the residuals of a repeated simulation with the logged hash."""
        number = int(np.searchsorted(self._begins, row, side="right")) - 1
        batch = self._batch(number)
        then = batch.column("residuals_hash")[row - int(self._begins[number])].as_py()
        self.differing += then is not None and then != residuals_hash(outcome.residuals)

    def close(self) -> None:
        """Close the segments, so that they may be replaced."""
        self._read = (-1, None)
        for mapped in self._segments:
            mapped.close()

    def note_answered(self, task: int) -> None:
        """Remember that a task was answered from the log, so that it is not logged again."""
        self._answered.add(task)

    def was_answered(self, task: int) -> bool:
        """Return whether a task was answered from the log, and forget it.

        It must be forgotten because the next runner counts its tasks from 0 again.
        """
        known = task in self._answered
        self._answered.discard(task)
        return known

    def _batch(self, number: int) -> pa.RecordBatch:
        if self._read[0] != number:
            segment, position = self._batches[number]
            mapped = self._segments[segment]
            mapped.seek(position)
            message = pa.ipc.read_message(mapped)
            self._read = number, pa.ipc.read_record_batch(message, self._schemas[segment])
        return self._read[1]


def _short(key: str, want: str) -> bytes:
    return f"{key[:KEY_LENGTH]}{want[:2]}".encode()


def _keys(batch: pa.RecordBatch) -> IntArray:
    pairs = zip(batch.column("key").to_pylist(), batch.column("want").to_pylist(), strict=True)
    return np.array([_short(*pair) for pair in pairs], f"S{KEY_LENGTH + 2}")


def _whole(batch: pa.RecordBatch) -> IntArray:
    """Return whether each row contains everything that an answer needs."""
    failed = pc.not_equal(batch.column("status"), str(Status.OK))
    want = batch.column("want")
    residuals = pc.is_valid(batch.column("residuals"))
    trajectory = pc.and_(residuals, pc.is_valid(batch.column("trajectory")))
    plain = pc.and_(pc.is_in(want, pa.array(USUAL)), residuals)
    whole = pc.or_(plain, pc.and_(pc.equal(want, "trajectory"), trajectory))
    found: IntArray = pc.or_(failed, whole).to_numpy(zero_copy_only=False)
    return found


def _floats(batch: pa.RecordBatch, name: str, row: int) -> FloatArray | None:
    values = batch.column(name)[row].values
    return None if values is None else np.array(values.to_numpy(zero_copy_only=False))


def _trajectory(batch: pa.RecordBatch, row: int) -> Trajectory | None:
    values = _floats(batch, "trajectory", row)
    times = _floats(batch, "times", row)
    if values is None or times is None:
        return None
    variables = tuple(batch.column("variables")[row].as_py())
    return Trajectory(variables, times, values.reshape(len(times), len(variables)))
