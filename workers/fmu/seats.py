"""Seats, one of which each instance needs if the number of instances is limited.

A seat is a file that the owner of the instance keeps locked. The system releases the lock when a
process ends for any reason. So a new instance waits until the old one no longer exists, even if its
process was killed.
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
"""Longest time in seconds to wait for a seat of another process. A killed process releases its
seat much earlier."""
SEAT_POLL_SECONDS = 0.01

_lock = threading.Lock()
_taken: dict[tuple[str, int], BaseFileLock] = {}
_lost: set[tuple[str, int]] = set()
"""Seats of this process, and those among them whose instance can never be freed."""


class Seat:
    """A seat that this process has taken for one instance.

    Parameters
    ----------
    seats
        Seats from which one is taken. Seats that this process already has are not waited for.
    file
        Name of the FMU, for messages.

    Raises
    ------
    ModelError
        If this process has all of them, if no other process releases one, or if files cannot be
        locked here.
    """

    def __init__(self, seats: Seats, file: str) -> None:
        self._key = _take(seats, file)

    def give_back(self) -> None:
        """Release the seat, because the instance was freed or could not be made."""
        with _lock:
            _taken.pop(self._key).release()

    def lose(self) -> None:
        """Keep the seat until this process ends, because its instance must not be called again."""
        with _lock:
            _lost.add(self._key)


def has_lost(seats: Seats | None) -> bool:
    """Return whether an instance on one of these seats can only be freed by ending the process."""
    return seats is not None and any((seats.program, n) in _lost for n in seats.numbers)


def program_seats(count: int) -> Seats:
    """Return this program's seats for `count` instances, without the lost ones.

    Raises
    ------
    ModelError
        If no seat remains.
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
    """Return the folder that contains a program's seats on this machine."""
    return Path(tempfile.gettempdir()) / f"cluster-est-seats-{program}"


@cache
def _program(process: int) -> str:
    """Return a unique name of this program; a fork of a program is another program."""
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
