"""Unpacking an FMU once on each machine, without trusting what is in it."""

from __future__ import annotations

import io
import lzma
import os
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath

import platformdirs

from workers.errors import ModelError

MAX_UNPACKED_BYTES = 4 * 2**30
MAX_RATIO = 200
"""Unpacked over packed size. Text in FMUs reaches 50, a zip bomb of zeros a thousand."""

HARMLESS_BYTES = 64 * 2**20
"""Unpacked size below which the ratio does not matter."""

DAMAGED = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, RuntimeError, ValueError
)  # fmt: skip
"""What zipfile raises for damaged, encrypted or unknown content."""


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
        If it is no zip file, if a path in it leaves the folder, if it is suspiciously large, or if
        the cache folder cannot be written.
    """
    target = unpacked_folder(archive_hash)
    if target.is_dir():
        return target
    with open_archive(name, archive) as opened:
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            private = Path(tempfile.mkdtemp(prefix="unpacking-", dir=target.parent))
        except OSError as error:
            raise ModelError(
                f"{name}: cannot be unpacked into {target.parent} ({error.strerror}); set "
                "CLUSTER_EST_CACHE to a folder that can be written"
            ) from error
        _extract(name, opened, private, target)
    return target


def unpacked_folder(archive_hash: str) -> Path:
    """Return the folder that an FMU is unpacked into on this machine."""
    home = Path(os.environ.get("CLUSTER_EST_CACHE") or platformdirs.user_cache_dir("cluster-est"))
    return home / "fmus" / archive_hash


def _extract(name: str, opened: zipfile.ZipFile, private: Path, target: Path) -> None:
    """Extract an archive into a private folder, and rename that to the target."""
    try:
        opened.extractall(private)
        private.rename(target)
    except OSError as error:
        if not target.is_dir():  # no other process was faster
            raise ModelError(
                f"{name}: cannot be unpacked into {target.parent} ({error.strerror}); make "
                "room there, or export the FMU again"
            ) from error
    except DAMAGED as error:
        raise ModelError(f"{name}: cannot be unpacked ({error}); export it again") from error
    finally:
        shutil.rmtree(private, ignore_errors=True)


def open_archive(name: str, archive: bytes) -> zipfile.ZipFile:
    """Open an FMU's zip file and check every entry before anything is written."""
    try:
        opened = zipfile.ZipFile(io.BytesIO(archive))
    except (*DAMAGED, OSError) as error:
        raise ModelError(
            f"{name}: must be an FMU, which is a zip file, but is not ({error}); export it again"
        ) from error
    entries = opened.infolist()
    for entry in entries:
        _check_entry(name, entry)
        # Some tools on Windows write its separator, which the zip format forbids
        entry.filename = entry.filename.replace("\\", "/")
    opened.NameToInfo = {entry.filename: entry for entry in entries}
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > MAX_UNPACKED_BYTES or unpacked > max(HARMLESS_BYTES, MAX_RATIO * len(archive)):
        raise ModelError(
            f"{name}: would unpack to {unpacked / 2**20:.0f} MiB from {len(archive) / 2**20:.1f} "
            "MiB, which is no ordinary FMU; nothing was unpacked"
        )
    return opened


def _check_entry(name: str, entry: zipfile.ZipInfo) -> None:
    if not entry.filename:
        raise ModelError(
            f"{name}: every entry in it must have a name but one has none; export it again"
        )
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    leaves = path.is_absolute() or ".." in path.parts or ":" in entry.filename.split("/")[0]
    if leaves or stat.S_ISLNK(entry.external_attr >> 16):
        raise ModelError(
            f"{name}: the path {entry.filename!r} in it must stay inside the FMU's folder but "
            "leaves it; nothing was unpacked, do not trust this file"
        )
