"""One process at a time in a log: a lock that is gone when its process is, however that ended."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cluster_est.errors import RunFolderError

if sys.platform != "win32":
    import fcntl


def lock(folder: Path) -> int | None:
    """Lock a folder until what this gives back is closed with `os.close`.

    Some systems and network drives have no such locks: there, None comes back, or other machines
    do not notice it.

    Raises
    ------
    RunFolderError
        If another process has it.
    """
    if sys.platform == "win32":
        return None
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(opened)
        raise RunFolderError(
            f"{folder}: another process is at work here; wait for it or end it"
        ) from None
    except OSError:
        os.close(opened)
        return None
    return opened


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock for a while."""
    held = lock(folder)
    try:
        yield
    finally:
        if held is not None:
            os.close(held)
