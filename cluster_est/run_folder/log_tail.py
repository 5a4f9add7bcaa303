"""A log read while it is written: only what is new, and never more than its small columns.

Segments are mapped, so residuals and trajectories are not read at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from cluster_est.run_folder.log_format import segments


@dataclass
class _SegmentPosition:
    """The position up to which a segment has been read."""

    file: int = 0
    offset: int = 0
    rows: int = 0
    schema: pa.Schema | None = None


class LogTail:
    """Gives the whole batches that have come since it was asked last.

    A torn end is normal: it comes when it is whole. Nothing is locked and nothing written.

    Parameters
    ----------
    folder
        `evaluations` of a run folder; may not be there yet.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._places: dict[str, _SegmentPosition] = {}

    def new(self) -> Iterator[pa.RecordBatch]:
        """The new batches, the oldest first."""
        for path in segments(self._folder):
            place = self._places.setdefault(path.name, _SegmentPosition())
            try:
                found = path.stat()
                if found.st_size <= place.offset and found.st_ino == place.file:
                    continue
                yield from self._read(path, place, found.st_ino)
            except OSError:  # it was replaced or removed just now: the next call sees it
                continue

    def _read(self, path: Path, place: _SegmentPosition, file: int) -> Iterator[pa.RecordBatch]:
        seen = 0
        if file != place.file:  # new, or rewritten without its large columns
            place.file, place.offset, seen = file, 0, place.rows
        with pa.memory_map(str(path)) as mapped:
            try:
                mapped.seek(place.offset)
                if place.offset == 0:
                    place.schema = pa.ipc.read_schema(mapped)
                    place.offset = mapped.tell()
                while True:
                    batch = pa.ipc.read_record_batch(pa.ipc.read_message(mapped), place.schema)
                    place.offset = mapped.tell()
                    new = batch.slice(min(seen, batch.num_rows))
                    seen -= batch.num_rows - new.num_rows
                    place.rows += new.num_rows
                    if new.num_rows:
                        yield new
            except (pa.ArrowInvalid, EOFError):
                return
