"""Folders for what is kept between runs: unpacked FMUs and the simulation core.

What is read from them is executed, so that they must belong to this user, and nobody else may write
into them. Where there is no such folder, a temporary one takes its place.
"""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import platformdirs

from workers.errors import ModelError

KEY = "CLUSTER_EST_CACHE"
_replaced: dict[str, str] = {}
"""Where caches are that cannot be in the folder that was meant, by the folder."""
_last_resorts: list[Path] = []


def cache_folder(kind: str, chosen: str = "") -> Path:
    """Return the folder of a kind of cache, which this user alone can write.

    Parameters
    ----------
    kind
        Its name.
    chosen
        The folder that it is in; without, that of `CLUSTER_EST_CACHE`, or the user's.

    Raises
    ------
    ModelError
        If no folder can be written.
    """
    meant = chosen or os.environ.get(KEY) or _user_folder()
    if meant and _is_private(Path(meant) / kind):
        return Path(meant) / kind
    for base in _others(Path(meant)):
        if _is_private(base) and _is_private(base / kind):
            if not meant or base.parent != Path(meant):
                _replaced[meant] = str(base)
            return base / kind
    raise ModelError(
        f"caches: need a writable folder, but neither {meant or 'a home folder'} nor the folder "
        f"for temporary files can be written to; set {KEY} to a folder that you can write to"
    )


def notice() -> str:
    """Say where caches are that cannot be where they were meant to be; "" if all are there."""
    if not _replaced:
        return ""
    meant, base = next(iter(_replaced.items()))
    why = (
        f"{meant} is not a folder that only this user can write to"
        if meant
        else "this user has no home folder"
    )
    return (
        f"unpacked FMUs and the simulation core are kept in {base}, because {why}; to change that, "
        f"set {KEY} to another folder"
    )


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that nobody ever reads a part of it, not even after a loss of power.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    handle, name = tempfile.mkstemp(prefix=".writing-", dir=path.parent)
    try:
        with open(handle, "wb") as opened:
            opened.write(content)
            opened.flush()
            os.fsync(opened.fileno())
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def is_mine(found: os.stat_result) -> bool:
    """Return whether a file or folder belongs to this user, where that is known."""
    return found.st_uid == _user() if hasattr(os, "geteuid") else True


def _user() -> int:
    return os.geteuid() if hasattr(os, "geteuid") else 0


def _user_folder() -> str:
    """Return the user's folder for caches; "" for a user without a home."""
    try:
        found = platformdirs.user_cache_dir("cluster-est")
    except (RuntimeError, KeyError, OSError):
        return ""
    return found if os.path.isabs(found) else ""


def _others(meant: Path) -> Iterator[Path]:
    """One of this user in a folder of several; temporary ones of this user, of this process."""
    if meant != Path():
        yield meant / f"user-{_user()}"
    with contextlib.suppress(OSError):
        yield Path(tempfile.gettempdir()) / f"cluster-est-cache-{_user()}"
        if not _last_resorts:
            _last_resorts.append(Path(tempfile.mkdtemp(prefix="cluster-est-cache-")))
        yield _last_resorts[0]


def _is_private(folder: Path) -> bool:
    """Make a folder if it is missing; return whether this user, and nobody else, can write it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or not is_mine(found):
            return False
        if found.st_mode & 0o022 and hasattr(os, "geteuid"):
            folder.chmod(0o700)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
