"""What the test FMU `counts_instances` has noted of its instances, over all processes.

It counts for itself, with a lock of its own and what the kernel says of processes: nothing of the
project is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

VARIABLE = "INSTANCES_COUNTED_IN"


@dataclass(frozen=True)
class CountedInstances:
    """The instances since a folder was emptied."""

    folder: Path

    def forget(self) -> None:
        """Count from here; instances that are still there are no longer known."""
        for file in self.folder.iterdir():
            file.unlink()

    @property
    def made(self) -> int:
        """How many there have been, one after the other or at once."""
        return len(self._alive())

    @property
    def most(self) -> int:
        """The largest number that there was at once."""
        return max(self._alive())

    @property
    def processes(self) -> set[int]:
        """Those in which there was one."""
        return {int(words[1]) for words in self._lines() if words[0] == "MADE"}

    def _alive(self) -> list[int]:
        """How many there were with each, when it was made."""
        return [int(words[2]) for words in self._lines() if words[0] == "MADE"]

    def _lines(self) -> list[list[str]]:
        text = (self.folder / "log").read_text(encoding="ascii")
        return [line.split() for line in text.splitlines()]
