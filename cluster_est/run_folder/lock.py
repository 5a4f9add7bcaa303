"""Locks that allow only one process at a time in a folder.

`filelock` locks a file in the folder. The lock ends with its process, however that ends. On some
network drives, other machines do not see the lock, or locks are not supported. A sweep therefore
also writes a file with its process and host. Such a file of a process of this machine that has
ended is ignored; whether a process of another machine is still alive is unknown.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from filelock import BaseFileLock, FileLock, Timeout

from cluster_est.errors import RunFolderError

LOCK, OWNER = ".lock", ".owner"
SWEEP_LOCK, SWEEP_OWNER = ".sweep.flock", ".sweep.lock"


def lock(folder: Path, name: str = LOCK) -> BaseFileLock | None:
    """Lock a folder until the returned lock is released or the process ends.

    Returns
    -------
    BaseFileLock | None
        None if locks are not supported, as on some network drives and in folders that are not
        writable.

    Raises
    ------
    RunFolderError
        If another process has locked it.
    """
    held = FileLock(folder / name, blocking=False, thread_local=False, fallback_to_soft=False)
    try:
        held.acquire()
    except Timeout:
        raise RunFolderError(
            f"{folder}: another process is running here ({_named(folder / OWNER)}); wait for it, "
            "or end it"
        ) from None
    except OSError:
        return None
    return held


def is_left(folder: Path) -> bool:
    """Return whether a folder was locked before, and no process of this machine locks it now."""
    if not (folder / LOCK).is_file():
        return False
    try:
        held = lock(folder)
    except RunFolderError:
        return False
    if held is None:
        return False
    held.release()
    return True


class RunLock:
    """A lock of a run's log against other processes, until it is released or this process ends.

    Parameters
    ----------
    folder
        `evaluations` of a run folder.

    Raises
    ------
    RunFolderError
        If another process has locked it. The message contains its process id and host.
    """

    def __init__(self, folder: Path) -> None:
        self._held = lock(folder)
        self._owner: Path | None = folder / OWNER
        with suppress(OSError):
            self._owner.write_text(json.dumps(_here()), encoding="utf-8")

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        owner, self._owner = self._owner, None
        if owner is not None:
            with suppress(OSError):
                owner.unlink(missing_ok=True)
            if self._held is not None:
                self._held.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


@contextmanager
def locked_by_sweep(folder: Path) -> Iterator[None]:
    """Lock a folder for a sweep, also against sweeps on other machines that share it.

    Raises
    ------
    RunFolderError
        If another sweep has locked it, or it is not writable.
    """
    owner = folder / SWEEP_OWNER
    try:
        held = lock(folder, SWEEP_LOCK)
    except RunFolderError:
        raise RunFolderError(
            f"{folder}: another sweep is running here ({_named(owner)}); wait for it, or end it"
        ) from None
    try:
        _own(owner, certain=held is not None)
        try:
            yield
        finally:
            owner.unlink(missing_ok=True)
    finally:
        if held is not None:
            held.release()


def _own(owner: Path, *, certain: bool) -> None:
    """Write the owner file, or replace that of a process of this machine that has ended.

    If the system's lock was free, that process has certainly ended.
    """
    here = _here()
    try:
        try:
            with owner.open("x", encoding="utf-8") as file:
                json.dump(here, file)
        except FileExistsError:
            if not certain or _read(owner).get("host") != here["host"]:
                raise RunFolderError(
                    f"{owner.parent}: another sweep is running here ({_named(owner)}); wait for "
                    f"it, or remove {owner} if that process is gone"
                ) from None
            owner.write_text(json.dumps(here), encoding="utf-8")
    except OSError as error:
        raise RunFolderError(
            f"{owner.parent}: cannot be written ({error}); choose another folder"
        ) from error


def _here() -> dict[str, object]:
    return {"pid": os.getpid(), "host": socket.gethostname()}


def _named(owner: Path) -> str:
    found = _read(owner)
    return f"process {found.get('pid', '?')} on {found.get('host', '?')}"


def _read(owner: Path) -> dict[str, object]:
    try:
        found = json.loads(owner.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
