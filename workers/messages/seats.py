"""Seats: how many instances of an FMU may exist at once, as a worker is told."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self


@dataclass(frozen=True)
class Seats:
    """The seats that instances of an FMU may take: each takes one for as long as it exists.

    Whoever makes an instance takes a seat first (`workers.fmu.seats`), so that the limit holds for
    workers, for probes, and for a process in the place of one that was killed.

    Attributes
    ----------
    program
        Names the program whose seats these are.
    numbers
        Those that may be taken: of a pool all, of one of its workers its own.
    """

    program: str
    numbers: tuple[int, ...]

    def of_worker(self, worker: int) -> Self:
        """The one of a worker: an instance beside its own would be one too many."""
        return replace(self, numbers=self.numbers[worker : worker + 1])
