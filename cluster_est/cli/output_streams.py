"""Standard output and error that end no command, whoever has stopped reading them.

What the system refuses, because a pipe is closed or a disk full, is dropped, and the command goes
on: its results stand in files.
"""

from __future__ import annotations

import errno
import io
import sys
from typing import Any, TextIO

from typing_extensions import override


class _Outlet(io.FileIO):
    """A descriptor that takes everything; `refused` is the first reason why it did not."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self.refused: OSError | None = None

    @override
    def write(self, data: Any, /) -> int:
        if self.refused is None:
            try:
                return super().write(data)
            except OSError as error:
                self.refused = error
        return len(data)


class LenientStreams:
    """Takes the place of both streams of this process, where it has them."""

    def __init__(self) -> None:
        self._outlets: list[_Outlet] = []
        sys.stdout, sys.stderr = self._around(sys.stdout), self._around(sys.stderr)

    def _around(self, stream: TextIO) -> TextIO:
        try:
            stream.flush()
            outlet = _Outlet(stream.fileno())
        except (AttributeError, OSError, ValueError):  # none, or no file of the system
            return stream
        self._outlets.append(outlet)
        return io.TextIOWrapper(
            io.BufferedWriter(outlet),
            encoding=stream.encoding,
            errors=stream.errors,
            line_buffering=True,
        )

    def lost(self) -> str:
        """Say, as part of a sentence, why something could not be printed; "" if nobody reads it."""
        for stream in filter(None, (sys.stdout, sys.stderr)):
            stream.flush()
        refused = [each.refused for each in self._outlets if each.refused is not None]
        reasons = [error.strerror or str(error) for error in refused if error.errno != errno.EPIPE]
        return reasons[0] if reasons else ""
