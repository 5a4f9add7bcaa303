"""Folders for files that are kept between runs: unpacked FMUs and the simulation core.

Their files are executed, so the folders must belong to this user, and nobody else may write to
them. If there is no such folder, a temporary one is used.
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
"""Replacements of folders that cannot be used, by folder."""
_last_resorts: list[Path] = []


def cache_folder(kind: str, chosen: str = "") -> Path:
    """Return the folder of a kind of cache, which only this user can write to.

    Parameters
    ----------
    kind
        Name of the kind.
    chosen
        The parent folder; if empty, that of `CLUSTER_EST_CACHE`, or the user's cache folder.

    Raises
    ------
    ModelError
        If no folder can be written to.
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
    """Return a message about a replaced cache folder; "" if none was replaced."""
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
    """Write a file atomically and durably, so that nobody reads a part of it after a power loss.

    Raises
    ------
    OSError
        If the file cannot be written.
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
    """Return whether a file or folder belongs to this user; True if the system has no user ids."""
    return found.st_uid == _user() if hasattr(os, "geteuid") else True


def _user() -> int:
    return os.geteuid() if hasattr(os, "geteuid") else 0


def _user_folder() -> str:
    """Return the user's cache folder; "" for a user without a home folder."""
    try:
        found = platformdirs.user_cache_dir("cluster-est")
    except (RuntimeError, KeyError, OSError):
        return ""
    return found if os.path.isabs(found) else ""


def _others(meant: Path) -> Iterator[Path]:
    """Yield folders to try instead: one per user in `meant`, then temporary ones."""
    if meant != Path():
        yield meant / f"user-{_user()}"
    with contextlib.suppress(OSError):
        yield Path(tempfile.gettempdir()) / f"cluster-est-cache-{_user()}"
        if not _last_resorts:
            _last_resorts.append(Path(tempfile.mkdtemp(prefix="cluster-est-cache-")))
        yield _last_resorts[0]


def _is_private(folder: Path) -> bool:
    """Make a folder if it is missing; return whether only this user can write to it."""
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
