"""Detection of a process that makes no progress, in contrast to one that waits on a busy machine.

A simulating process records its progress in memory shared with the process that waits for it. As
long as there is no progress, only usable time counts: its processor time, and the time that it
sleeps. Time in which it is ready to run but does not run, or in which it is stopped, does not
count.
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
"""Longest time, in seconds, that counts as sleep between two observations. A longer interval means
that the observer itself was delayed."""
WAITING = "RTtD"
"""States of Linux in which a thread cannot run although it could continue: ready to run, stopped,
or waiting for a disk, as on a machine short of memory. `executor.timeout` applies nevertheless."""


class SharedProgress:
    """Progress in memory shared by this process and all that receive its descriptor.

    Attributes
    ----------
    descriptor
        Descriptor of the memory, for `map_progress`.
    progress
        See `workers.messages.types`.
    """

    def __init__(self) -> None:
        self.descriptor = _anonymous_file()
        os.ftruncate(self.descriptor, mmap.PAGESIZE)
        self.progress = map_progress(self.descriptor)

    def close(self) -> None:
        """Close the descriptor. A second call does nothing."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


def map_progress(descriptor: int) -> IntArray:
    """Return the progress in memory that another process has made."""
    memory = mmap.mmap(descriptor, mmap.PAGESIZE)
    return np.frombuffer(memory, np.int64, count=len(no_watcher()))


@dataclass(frozen=True)
class ProcessActivity:
    """The state of a process, as reported by the operating system.

    Attributes
    ----------
    waiting
        Whether one of its threads is in a state of `WAITING`.
    seconds
        Processor time so far.
    """

    waiting: bool
    seconds: float

    @classmethod
    def of(cls, process: int) -> ProcessActivity | None:
        """Return the state of a process; None if the system does not report it."""
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
    """Observes the progress of a process.

    Parameters
    ----------
    process
        Process id.
    progress
        Progress that the process records; an observation resets its flag of a call.

    Attributes
    ----------
    still
        Seconds without progress.
    """

    def __init__(self, process: int, progress: IntArray) -> None:
        self._process, self._progress = process, progress
        self._begun = progress[SIMULATIONS:].tolist()
        self._looked = time.monotonic()
        self._activity = ProcessActivity.of(process)
        self.still = 0.0
        self._simulated = 0.0

    def look(self) -> None:
        """Count the time since the last observation."""
        now, activity = time.monotonic(), ProcessActivity.of(self._process)
        called, *begun = self._progress.tolist()
        self._progress[CALLED] = 0
        if begun[0] != self._begun[0]:
            self._simulated = 0.0
        else:  # a long interval means that observer and simulation were delayed
            self._simulated += min(now - self._looked, LATE_SECONDS)
        passed = self._passed(now - self._looked, activity)
        self.still = 0.0 if called or begun != self._begun else self.still + passed
        self._begun, self._looked, self._activity = begun, now, activity

    @property
    def simulates(self) -> bool:
        """Whether a simulation is running; otherwise one is prepared or compared with data."""
        return bool(self._progress[RUNNING])

    @property
    def simulated(self) -> float:
        """Seconds since the running simulation was first observed."""
        return self._simulated if self.simulates else 0.0

    def _passed(self, seconds: float, activity: ProcessActivity | None) -> float:
        """Return the part of the seconds since the last observation that the process could use."""
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
