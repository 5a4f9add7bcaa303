"""Unpacking an FMU once on each machine, without trusting what is in it."""

from __future__ import annotations

import io
import os
import shutil
import stat
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

import platformdirs

from workers.errors import ModelError

MAX_UNPACKED_BYTES = 4 * 2**30
MAX_RATIO = 1000
"""Unpacked over packed size. Text in FMUs reaches 50; only a zip bomb comes near a thousand."""


def unpack(name: str, archive: bytes, archive_hash: str) -> Path:
    """Unpack an FMU into the cache folder of this machine, unless it is there already.

    Processes that do this at the same time do not meet: each unpacks into a folder of its own and
    renames it, which is atomic.

    Parameters
    ----------
    name
        The file's name, for messages.
    archive
        The bytes of the FMU.
    archive_hash
        Their hash, the name of the folder.

    Raises
    ------
    ModelError
        If it is no zip file, if a path in it leaves the folder, or if it is suspiciously large.
    """
    home = Path(os.environ.get("CLUSTER_EST_CACHE") or platformdirs.user_cache_dir("cluster-est"))
    target = home / "fmus" / archive_hash
    if target.is_dir():
        return target
    with open_archive(name, archive) as opened:
        target.parent.mkdir(parents=True, exist_ok=True)
        private = Path(tempfile.mkdtemp(prefix="unpacking-", dir=target.parent))
        try:
            opened.extractall(private)
            private.rename(target)
        except OSError:
            if not target.is_dir():
                raise
        except (zipfile.BadZipFile, RuntimeError, NotImplementedError) as error:
            raise ModelError(f"{name}: cannot be unpacked ({error}); export it again") from error
        finally:
            shutil.rmtree(private, ignore_errors=True)
    return target


def open_archive(name: str, archive: bytes) -> zipfile.ZipFile:
    """Open an FMU's zip file and check every entry before anything is written."""
    try:
        opened = zipfile.ZipFile(io.BytesIO(archive))
    except (zipfile.BadZipFile, ValueError, OSError) as error:
        raise ModelError(
            f"{name}: must be an FMU, which is a zip file, but is not ({error}); export it again"
        ) from error
    entries = opened.infolist()
    for entry in entries:
        _check_entry(name, entry)
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > MAX_UNPACKED_BYTES or unpacked > MAX_RATIO * max(len(archive), 1024):
        raise ModelError(
            f"{name}: would unpack to {unpacked / 2**20:.0f} MiB from {len(archive) / 2**20:.1f} "
            "MiB, which is no ordinary FMU; nothing was unpacked"
        )
    return opened


def _check_entry(name: str, entry: zipfile.ZipInfo) -> None:
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    leaves = path.is_absolute() or ".." in path.parts or ":" in entry.filename.split("/")[0]
    if leaves or stat.S_ISLNK(entry.external_attr >> 16):
        raise ModelError(
            f"{name}: the path {entry.filename!r} in it must stay inside the FMU's folder but "
            "leaves it; nothing was unpacked, do not trust this file"
        )
