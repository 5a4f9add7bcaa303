"""The progress of a run: a small file for those who watch its folder from elsewhere.

The file has a line for each iteration of each search, and one a second for the whole run. It is a
log and no result; nothing reads it to go on.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from cluster_est.errors import RunFolderError
from cluster_est.methods.method import Progress
from cluster_est.running.resources import BestPoint, RunSnapshot, SearchIteration
from cluster_est.whole_files import MEND, SEAL, is_damaged, is_sealed, sealed

PROGRESS = "progress.jsonl"
SECONDS_BETWEEN_LINES = 1.0
MOST_PROGRESS_BYTES = 8 * 2**20
"""Bytes above which the file begins anew with the last line of each search."""


class ProgressFile:
    """Appends lines; who cannot write them loses the view, never the run."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: dict[str, str] = {}
        self._shown = 0.0
        self._size = 0
        self._ended = False
        self._lock = threading.Lock()  # a heartbeat comes from a thread of its own
        path.write_bytes(b"")

    def iteration(self, iteration: SearchIteration) -> None:
        """A new line of a search's iteration table."""
        progress = iteration.progress
        row = IterationLine(
            iteration.search, progress.iteration, progress.cost, progress.violation,
            progress.ending, iteration.evaluations,
        )  # fmt: skip
        best = None if iteration.best is None else _finite(vars(iteration.best))
        self._last[iteration.search] = line = _line({**vars(row), "best": best})
        self._write(line)

    def show(self, snapshot: RunSnapshot) -> None:
        """The state of the whole run, at most once a second; nothing after the end."""
        now = time.monotonic()
        if now - self._shown < SECONDS_BETWEEN_LINES:
            return
        self._shown = now
        row = {field.name: getattr(snapshot, field.name) for field in fields(snapshot)}
        del row["progress"]
        self._write(_line({"now": row.pop("search"), **row}))

    def end(self) -> None:
        """Nothing follows: whatever reads less than this of a run that has ended lacks lines."""
        self._write(_line({"end": True}), end=True)

    def _write(self, line: str, *, end: bool = False) -> None:
        with self._lock, suppress(OSError):
            if self._ended:
                return
            self._ended = end
            text = line.encode()
            if self._size > MOST_PROGRESS_BYTES:
                text, self._size = "".join(self._last.values()).encode() + text, 0
            with self._path.open("r+b") as file:
                file.truncate(self._size)  # what of a line was written before the disk was full
                file.seek(self._size)
                file.write(text)
            self._size += len(text)


def _line(row: dict[str, Any]) -> str:
    """One line of JSON, which has no NaN."""
    return sealed(json.dumps({"checksum": SEAL, **_finite(row)}).encode()).decode() + "\n"


def _finite(row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


@dataclass(frozen=True)
class IterationLine:
    """One iteration of a search, and the best point until then; costs are NaN where there was none.

    `best` is None too where a cost at it is infinite.
    """

    search: str
    iteration: int
    cost: float
    violation: float
    ending: str
    evaluations: int
    best: BestPoint | None = None


class ProgressTail:
    """Reads a progress file while it grows, only what is new.

    Attributes
    ----------
    state
        The last one, without the progress of its search; None before the first.
    damaged
        How many lines are not as they were written; they are left out.
    ended
        Whether its last line was read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._torn = b""
        self.damaged, self.ended = 0, False
        self.state: RunSnapshot | None = None

    def new(self) -> list[IterationLine]:
        """The iterations since the last call; a line that is half written comes with the next."""
        try:
            with self._path.open("rb") as file:
                if file.seek(0, 2) < self._offset:  # it has begun anew
                    self._offset, self._torn, self.damaged, self.ended = 0, b"", 0, False
                file.seek(self._offset)
                found = file.read()
                self._offset = file.tell()
        except OSError:
            return []
        *whole, self._torn = (self._torn + found).split(b"\n")
        read = [self._read(line) for line in whole]
        return [line for line in read if line is not None]

    def check(self) -> None:
        """Check what was read of a run that has ended.

        Raises
        ------
        RunFolderError
            If a line is not as it was written, or the last one is missing.
        """
        lost = self.damaged + bool(self._torn)
        if lost:
            what = f"{lost} of its lines {'has' if lost == 1 else 'have'}"
            raise RunFolderError(
                f"{self._path}: the file is damaged: {what} changed since it was written; {MEND}"
            )
        if not self.ended and self._path.is_file():
            raise RunFolderError(f"{self._path}: the file is damaged: its end is missing; {MEND}")

    def _read(self, text: bytes) -> IterationLine | None:
        if is_damaged(text) or not is_sealed(text):
            self.damaged += 1
            return None
        try:
            row = json.loads(text)
            row.pop("checksum", None)
            if "end" in row:
                self.ended = True
                return None
            if "now" in row:
                for name in ("left", "pace"):
                    row[name] = math.nan if row.get(name) is None else float(row[name])
                self.state = RunSnapshot(row.pop("now"), Progress(0, math.nan), **row)
                return None
            for name in ("cost", "violation"):
                row[name] = math.nan if row[name] is None else float(row[name])
            best = row.pop("best", None)
            known = best is not None and None not in (best["cost"], best["violation"])
            return IterationLine(**row, best=BestPoint(**best) if known else None)
        except (ValueError, TypeError, KeyError, AttributeError):  # no line of such a file
            return None
