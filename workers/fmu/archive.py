"""Unpacking of an FMU, once on each machine and with checks of its content."""

from __future__ import annotations

import contextlib
import io
import lzma
import os
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from workers.caches import cache_folder, is_mine, write_whole
from workers.errors import ModelError

MAX_UNPACKED_BYTES = 4 * 2**30
MAX_RATIO = 200
"""Largest ratio of unpacked to packed size. Text in FMUs reaches 50, a zip bomb of zeros 1000."""

HARMLESS_BYTES = 64 * 2**20
"""Unpacked size below which the ratio is not checked."""

DAMAGED = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, RuntimeError, ValueError
)  # fmt: skip
"""Exceptions of zipfile for damaged, encrypted or unknown content."""


Stamps = dict[str, tuple[int, ...] | None]
_checked: dict[Path, Stamps] = {}
"""Attributes of files that this process, or the one it was forked from, has verified."""


def unpack(name: str, archive: bytes, archive_hash: str) -> Path:
    """Unpack an FMU into the cache folder of this machine, unless it is there already.

    Processes can do this at the same time: each unpacks into its own folder and then renames it,
    which is atomic. Existing files are compared with the archive. Files that are damaged or belong
    to another user are written again.

    Parameters
    ----------
    name
        Name of the file, for messages.
    archive
        The bytes of the FMU.
    archive_hash
        Their hash, which is the name of the folder.

    Raises
    ------
    ModelError
        If it is not a zip file, if a path in it leaves the folder, if it is suspiciously large, or
        if the cache folder is not writable.
    """
    target = unpacked_folder(archive_hash)
    known = _checked.get(target)
    is_there = _is_own_folder(target)
    if is_there and known is not None and known == _stamps(target, known):
        return target
    with open_archive(name, archive) as opened:
        if not is_there:
            _unpack_anew(name, opened, target)
        try:
            _mend(opened, target)
        except OSError as error:
            raise _unwritable(name, target.parent, error) from error
        except DAMAGED as error:
            raise ModelError(f"{name}: cannot be unpacked ({error}); export it again") from error
        _checked[target] = _stamps(target, [entry.filename for entry in _files(opened)])
    return target


def unpacked_folder(archive_hash: str) -> Path:
    """Return the folder into which an FMU is unpacked on this machine."""
    return cache_folder("fmus") / archive_hash


def prepare_folder() -> None:
    """Determine the folder of unpacked FMUs, so that `caches.notice` works in this process."""
    cache_folder("fmus")


def _is_own_folder(target: Path) -> bool:
    """Return whether an FMU is unpacked there; remove anything but a folder of this user."""
    try:
        found = target.lstat()
    except OSError:
        return False
    if stat.S_ISDIR(found.st_mode) and is_mine(found):
        return True
    _remove(target)
    return False


def _remove(path: Path) -> None:
    """Remove a file or folder, and ignore errors."""
    shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):
        path.unlink()


def _unpack_anew(name: str, opened: zipfile.ZipFile, target: Path) -> None:
    try:
        private = Path(tempfile.mkdtemp(prefix="unpacking-", dir=target.parent))
    except OSError as error:
        raise _unwritable(name, target.parent, error) from error
    _extract(name, opened, private, target)


def _unwritable(name: str, folder: Path, error: OSError) -> ModelError:
    return ModelError(
        f"{name}: cannot be unpacked into {folder} ({error.strerror}); free some space there, or "
        "set CLUSTER_EST_CACHE to a folder that can be written to"
    )


def _mend(opened: zipfile.ZipFile, target: Path) -> None:
    """Rewrite files that differ from the archive; open files keep their old content."""
    for entry in _files(opened):
        file = target / entry.filename
        if _is_as_packed(file, entry):
            continue
        for folder in reversed(file.relative_to(target).parents[:-1]):
            if (target / folder).is_symlink() or not (target / folder).is_dir():
                _remove(target / folder)
                (target / folder).mkdir(exist_ok=True)
        if file.is_dir() and not file.is_symlink():
            _remove(file)
        write_whole(file, opened.read(entry))


def _is_as_packed(file: Path, entry: zipfile.ZipInfo) -> bool:
    """Return whether a file belongs to this user and has the archive's length and checksum."""
    try:
        found = file.lstat()
        if not (stat.S_ISREG(found.st_mode) and is_mine(found)):
            return False
        return found.st_size == entry.file_size and zlib.crc32(file.read_bytes()) == entry.CRC
    except OSError:
        return False


def _files(opened: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the entries that are files; if a name occurs several times, the last entry."""
    return [entry for entry in opened.NameToInfo.values() if not entry.is_dir()]


def _stamps(target: Path, names: Iterable[str]) -> Stamps:
    """Return attributes that reveal changes of files; None for a missing file."""
    stamps: Stamps = {}
    for name in names:
        try:
            found = (target / name).lstat()
        except OSError:
            stamps[name] = None
            continue
        stamps[name] = found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
    return stamps


def _extract(name: str, opened: zipfile.ZipFile, private: Path, target: Path) -> None:
    """Extract an archive into a private folder, and rename that folder to the target."""
    try:
        opened.extractall(private)
        for file in private.rglob("*"):
            _write_through(file)
        private.rename(target)
    except OSError as error:
        if not target.is_dir():  # no other process was faster
            raise ModelError(
                f"{name}: cannot be unpacked into {target.parent} ({error.strerror}); free some "
                "space there, or export the FMU again"
            ) from error
    except DAMAGED as error:
        raise ModelError(f"{name}: cannot be unpacked ({error}); export it again") from error
    finally:
        shutil.rmtree(private, ignore_errors=True)


def _write_through(file: Path) -> None:
    """Write a file's content to the disk before its folder is renamed."""
    if file.is_file():
        handle = os.open(file, os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def open_archive(name: str, archive: bytes) -> zipfile.ZipFile:
    """Open the zip file of an FMU and check every entry before anything is written."""
    try:
        opened = zipfile.ZipFile(io.BytesIO(archive))
    except (*DAMAGED, OSError) as error:
        raise ModelError(
            f"{name}: must be an FMU, which is a zip file, but is not ({error}); export it again"
        ) from error
    entries = opened.infolist()
    for entry in entries:
        _check_entry(name, entry)
        # Some tools on Windows use backslashes, which the zip format forbids
        entry.filename = entry.filename.replace("\\", "/")
    opened.NameToInfo = {entry.filename: entry for entry in entries}
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > MAX_UNPACKED_BYTES or unpacked > max(HARMLESS_BYTES, MAX_RATIO * len(archive)):
        raise ModelError(
            f"{name}: nothing was unpacked, because it would grow from {len(archive) / 2**20:.1f} "
            f"to {unpacked / 2**20:.0f} MiB, which is unusual for an FMU; check where the file "
            "comes from"
        )
    return opened


def _check_entry(name: str, entry: zipfile.ZipInfo) -> None:
    if not entry.filename:
        raise ModelError(
            f"{name}: every entry in the FMU must have a name, but one has none; export it again"
        )
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    leaves = path.is_absolute() or ".." in path.parts or ":" in entry.filename.split("/")[0]
    if leaves or stat.S_ISLNK(entry.external_attr >> 16):
        raise ModelError(
            f"{name}: the path {entry.filename!r} in it must stay inside the FMU's folder, but "
            "leaves it. Nothing was unpacked; do not trust this file"
        )
