"""Telling a process that stands still from one that waits for its turn on a busy machine.

A process that is simulated in notes its progress in memory that it shares with the one that waits
for it. While nothing is noted, the time counts in which something could have been: the processor
time that it was given, and the time that it slept of its own accord. While it is ready to run and
others are running, or somebody has stopped it, no time passes for it.
"""

from __future__ import annotations

import mmap
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workers.messages import IntArray
from workers.messages.types import CALLED, RUNNING, SIMULATIONS, no_watcher

LATE_SECONDS = 1.0
"""Seconds of sleep that count from one look to the next: who looks so rarely was kept from
looking."""
WAITING = "RTtD"
"""States of Linux in which a thread would go on if it were let: ready to run, stopped, or waiting
for a disk, as on a machine whose memory is short. `executor.timeout` ends it all the same."""


class SharedProgress:
    """Progress in memory that this process and those that are given its descriptor share.

    Attributes
    ----------
    descriptor
        Of the memory, to be mapped by `map_progress`.
    progress
        See `workers.messages.types`.
    """

    def __init__(self) -> None:
        self.descriptor = _anonymous_file()
        os.ftruncate(self.descriptor, mmap.PAGESIZE)
        self.progress = map_progress(self.descriptor)

    def close(self) -> None:
        """Give the descriptor back. Again does nothing."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


def map_progress(descriptor: int) -> IntArray:
    """The progress in memory that another process has made."""
    memory = mmap.mmap(descriptor, mmap.PAGESIZE)
    return np.frombuffer(memory, np.int64, count=len(no_watcher()))


@dataclass(frozen=True)
class ProcessActivity:
    """The state of a process, as the system gives it.

    Attributes
    ----------
    waiting
        Whether one of its threads would go on if it were let.
    seconds
        Of processor time that it was given so far.
    """

    waiting: bool
    seconds: float

    @classmethod
    def of(cls, process: int) -> ProcessActivity | None:
        """None where the system does not say."""
        try:
            text = Path(f"/proc/{process}/stat").read_text(encoding="ascii", errors="replace")
            fields = text.rpartition(")")[2].split()
            ticks = int(fields[11]) + int(fields[12])
            states = [_state(path) for path in Path(f"/proc/{process}/task").glob("*/stat")]
        except (OSError, IndexError, ValueError):
            return None
        waiting = any(state in WAITING for state in (fields[0], *states))
        return cls(waiting, ticks / os.sysconf("SC_CLK_TCK"))


class ProgressWatch:
    """Looks at a process from time to time.

    Parameters
    ----------
    process
        Its id.
    progress
        That it notes; a look erases that there was a call.

    Attributes
    ----------
    still
        Seconds for which it has stood still.
    """

    def __init__(self, process: int, progress: IntArray) -> None:
        self._process, self._progress = process, progress
        self._begun = progress[SIMULATIONS:].tolist()
        self._looked = time.monotonic()
        self._activity = ProcessActivity.of(process)
        self.still = 0.0
        self._simulated = 0.0

    def look(self) -> None:
        """Count the time since the last look."""
        now, activity = time.monotonic(), ProcessActivity.of(self._process)
        called, *begun = self._progress.tolist()
        self._progress[CALLED] = 0
        if begun[0] != self._begun[0]:
            self._simulated = 0.0
        else:  # who looks so rarely was kept from looking, and so was the simulation
            self._simulated += min(now - self._looked, LATE_SECONDS)
        passed = self._passed(now - self._looked, activity)
        self.still = 0.0 if called or begun != self._begun else self.still + passed
        self._begun, self._looked, self._activity = begun, now, activity

    @property
    def simulates(self) -> bool:
        """True while a simulation is under way; else it prepares one, or compares what it gave."""
        return bool(self._progress[RUNNING])

    @property
    def simulated(self) -> float:
        """Seconds since the simulation was first seen that is under way."""
        return self._simulated if self.simulates else 0.0

    def _passed(self, seconds: float, activity: ProcessActivity | None) -> float:
        """Return the part of some seconds since the last look that it could have used."""
        if activity is None or self._activity is None or not activity.waiting:
            return min(seconds, LATE_SECONDS)
        return min(seconds, activity.seconds - self._activity.seconds)


def _state(path: Path) -> str:
    """Return the state of a thread; "" if it has ended."""
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
    return text.rpartition(")")[2].split()[0]


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("cluster-est")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
