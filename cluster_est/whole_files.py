"""Files that are there whole or not at all, and that tell whether they are as they were written.

A *seal* is a text within a file, or within a part of it: the checksum of everything around it. Any
reader of the format sees it as a comment, as metadata or as one more key.
"""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cluster_est.errors import UnwritableError

SEAL = "cluster-est crc32:00000000"
"""What stands in the place of a seal until `sealed` fills it in."""
SEAL_KEY = "checksum"
"""The key of a seal in run.json, and in the metadata of tables and of messages of a log."""
MEND = "run the same command again with --resume to repeat the damaged parts"
MAKE_ROOM_AND_RESUME = (
    "check that there is free space and that the folder can be written to, and continue with "
    "--resume"
)
ELSEWHERE = (
    "check that there is free space and that the folder can be written to, or choose another folder"
)
_FILE_SEAL = re.compile(rb"cluster-est crc32:([0-9a-f]{8})")


def sealed(content: bytes) -> bytes:
    """Return a content in which the first `SEAL` has the checksum of all of it."""
    begin = content.index(SEAL.encode())
    end = begin + len(SEAL)
    return b"%b%08x%b" % (content[: end - 8], zlib.crc32(content), content[end:])


def is_sealed(content: bytes | memoryview) -> bool:
    """Return whether a content says what its checksum is; that of earlier versions does not."""
    return _FILE_SEAL.search(content) is not None


def is_damaged(content: bytes | memoryview) -> bool:
    """Return whether a content has a seal that it does not agree with."""
    seal = _FILE_SEAL.search(content)
    if seal is None:
        return False
    begin, end = seal.span(1)
    found = zlib.crc32(content[:begin])
    found = zlib.crc32(b"0" * 8, found)
    return zlib.crc32(content[end:], found) != int(seal[1], 16)


@contextmanager
def writing(path: Path, advice: str) -> Iterator[None]:
    """Say in a sentence, with the advice, that a file or folder could not be written.

    Raises
    ------
    UnwritableError
        In place of any `OSError`.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UnwritableError(f"{path}: cannot be written ({reason}); {advice}") from error


def write_whole(path: Path, content: bytes, advice: str, *, shared: bool = False) -> None:
    """Write a file in one step: it is on the disk, or what was there before stays.

    Parameters
    ----------
    path, content
        The file.
    advice
        What to do if it cannot be written, as part of a sentence.
    shared
        Whether other processes may write it too.

    Raises
    ------
    UnwritableError
        If it cannot be written.
    """
    partial = path.with_name(f".{path.name}" + (f".{os.getpid()}" if shared else ""))
    with writing(path, advice):
        if path.is_symlink() or (path.exists() and not path.is_file()):  # a device, a pipe
            path.write_bytes(content)
            return
        try:
            with partial.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except BaseException:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise


def write_output(path: Path, content: bytes) -> None:
    """Write the file that a command was told to write with --out, and the folders above it.

    Raises
    ------
    UnwritableError
        If it cannot be written.
    """
    advice = f"{ELSEWHERE} --out"
    with writing(path, advice):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content, advice, shared=True)
