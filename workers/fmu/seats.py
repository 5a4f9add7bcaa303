"""Taking a seat, without which no instance is made where their number is limited.

A seat is a file that whoever has the instance keeps locked. The system gives the lock back when a
process ends, however that happens: a new instance waits until the old one is gone, even if nobody
else knows any more what has become of the process that had it.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import threading
import time
import uuid
from functools import cache
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from workers.errors import ModelError
from workers.messages import Seats

WAIT_SECONDS = 120.0
"""Seconds for which a seat is waited that another process has: one that was killed is gone long
before."""
SEAT_POLL_SECONDS = 0.01

_lock = threading.Lock()
_taken: dict[tuple[str, int], BaseFileLock] = {}
_lost: set[tuple[str, int]] = set()
"""Seats of this process, and those of them whose instance can never be freed."""


class Seat:
    """A seat that this process has taken for one instance.

    Parameters
    ----------
    seats
        Of which one is taken. Those that this process has already are not waited for.
    file
        The FMU's name, for messages.

    Raises
    ------
    ModelError
        If this process has them all, if nobody gives one back, or if no file can be locked here.
    """

    def __init__(self, seats: Seats, file: str) -> None:
        self._key = _take(seats, file)

    def give_back(self) -> None:
        """Let another instance have it: this one was freed, or could not be made."""
        with _lock:
            _taken.pop(self._key).release()

    def lose(self) -> None:
        """Keep it until this process ends: its instance must not be called any more."""
        with _lock:
            _lost.add(self._key)


def has_lost(seats: Seats | None) -> bool:
    """Return whether an instance on one of these seats can only go with this process."""
    return seats is not None and any((seats.program, n) in _lost for n in seats.numbers)


def program_seats(count: int) -> Seats:
    """Return the seats of this program for so many instances, but those that it has lost.

    Raises
    ------
    ModelError
        If none is left.
    """
    program = _program(os.getpid())
    left = tuple(number for number in range(count) if (program, number) not in _lost)
    if not left:
        raise ModelError(
            f"executor.instances: allows {count} instances, but all of them had a fatal error in "
            "this process and cannot be freed; end the program and start it again"
        )
    return Seats(program, left)


def seats_folder(program: str) -> Path:
    """Return the folder in which a program's seats are files, on this machine."""
    return Path(tempfile.gettempdir()) / f"cluster-est-seats-{program}"


@cache
def _program(process: int) -> str:
    """Return a name that no other program has; a fork of a program is another one."""
    name = f"{process}-{uuid.uuid4().hex}"
    atexit.register(shutil.rmtree, seats_folder(name), ignore_errors=True)
    return name


def _take(seats: Seats, file: str) -> tuple[str, int]:
    end = time.monotonic() + WAIT_SECONDS
    while True:
        with _lock:
            keys = [(seats.program, number) for number in seats.numbers]
            for key in keys:
                if key not in _taken and (held := _locked(key, file)) is not None:
                    _taken[key] = held
                    return key
            if all(key in _taken for key in keys):
                raise ModelError(_all_here(seats, file))
        if time.monotonic() > end:
            raise ModelError(
                f"{file}: executor.instances allows no more instances, and none of the others was "
                f"freed within {WAIT_SECONDS:.0f} s; look for a process in which the FMU hangs, or "
                "raise executor.instances"
            )
        time.sleep(SEAT_POLL_SECONDS)


def _locked(key: tuple[str, int], file: str) -> BaseFileLock | None:
    """Return the lock of a seat; None if another process has it."""
    program, number = key
    folder = seats_folder(program)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        held = FileLock(folder / f"{number}", thread_local=False, fallback_to_soft=False)
        held.acquire(blocking=False)
    except Timeout:
        return None
    except (OSError, NotImplementedError) as error:
        raise ModelError(
            f"{file}: executor.instances needs a folder whose files can be locked, but "
            f"{folder.parent} is not one ({error}); set TMPDIR to a folder on a disk of this "
            "machine"
        ) from error
    return held


def _all_here(seats: Seats, file: str) -> str:
    if has_lost(seats):
        return (
            f"{file}: this process must free its instance of the FMU before it can make another "
            "one (executor.instances), but after a fatal error it cannot; set executor.name = "
            '"processes" or "ray", where the process is ended instead'
        )
    return (
        f"{file}: this process already has as many instances as executor.instances allows; raise "
        "executor.instances"
    )
