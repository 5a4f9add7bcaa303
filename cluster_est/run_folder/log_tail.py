"""A log read while it is written: only what is new."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa

from cluster_est.run_folder.log_segment import SegmentReader, segments


@dataclass
class _KnownSegment:
    """A segment as far as it was read: the file, its reader, and how many rows were given."""

    file: int = 0
    rows: int = 0
    reader: SegmentReader = field(default_factory=SegmentReader)


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
        self._known: dict[str, _KnownSegment] = {}

    def new(self) -> Iterator[pa.RecordBatch]:
        """The new batches, the oldest first.

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
            except OSError:  # it was replaced or removed just now: the next call sees it
                continue
            known.reader.check(path, ended=False)

    def check_ended(self) -> None:
        """Refuse a log that is torn although its run has reached its end.

        Raises
        ------
        RunFolderError
            If it is.
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
