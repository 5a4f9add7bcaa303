"""The progress file of a run, for programs that watch its folder.

It has a line for each iteration of each search, and a line each second for the complete run. It is
only a log, and it is not used to resume a run.
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
"""Size above which the file is restarted with the last line of each search."""


class ProgressFile:
    """Appends lines to a progress file; a failed write does not stop the run."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: dict[str, str] = {}
        self._shown = 0.0
        self._size = 0
        self._ended = False
        self._lock = threading.Lock()  # heartbeats come from another thread
        path.write_bytes(b"")

    def iteration(self, iteration: SearchIteration) -> None:
        """Add a line for an iteration of a search."""
        progress = iteration.progress
        row = IterationLine(
            iteration.search, progress.iteration, progress.cost, progress.violation,
            progress.ending, iteration.evaluations,
        )  # fmt: skip
        best = None if iteration.best is None else _finite(vars(iteration.best))
        self._last[iteration.search] = line = _line({**vars(row), "best": best})
        self._write(line)

    def show(self, snapshot: RunSnapshot) -> None:
        """Add a line with the state of the run, at most once a second and not after the end."""
        now = time.monotonic()
        if now - self._shown < SECONDS_BETWEEN_LINES:
            return
        self._shown = now
        row = {field.name: getattr(snapshot, field.name) for field in fields(snapshot)}
        del row["progress"]
        self._write(_line({"now": row.pop("search"), **row}))

    def end(self) -> None:
        """Add the last line, whose absence reveals a truncated file."""
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
                file.truncate(self._size)  # removes a partial line after a full disk
                file.seek(self._size)
                file.write(text)
            self._size += len(text)


def _line(row: dict[str, Any]) -> str:
    """Return one line of JSON, which has no NaN."""
    return sealed(json.dumps({"checksum": SEAL, **_finite(row)}).encode()).decode() + "\n"


def _finite(row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


@dataclass(frozen=True)
class IterationLine:
    """One iteration of a search, and the best point so far; missing costs are NaN.

    `best` is also None if a cost at it is infinite.
    """

    search: str
    iteration: int
    cost: float
    violation: float
    ending: str
    evaluations: int
    best: BestPoint | None = None


class ProgressTail:
    """Reads the new lines of a growing progress file.

    Attributes
    ----------
    state
        The last state, without the progress of its search; None before the first.
    damaged
        Number of damaged lines, which are ignored.
    ended
        Whether the last line was read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._torn = b""
        self.damaged, self.ended = 0, False
        self.state: RunSnapshot | None = None

    def new(self) -> list[IterationLine]:
        """Return the iterations since the last call; a partial line is read by the next call."""
        try:
            with self._path.open("rb") as file:
                if file.seek(0, 2) < self._offset:  # the file was restarted
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
        """Check the lines that were read of a finished run.

        Raises
        ------
        RunFolderError
            If a line was changed, or if the last line is missing.
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
        except (ValueError, TypeError, KeyError, AttributeError):  # not a line of such a file
            return None
