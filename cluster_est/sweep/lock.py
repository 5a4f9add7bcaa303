"""One sweep at a time in a folder, even when cron starts the next too early."""

from __future__ import annotations

import json
import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cluster_est.errors import RunFolderError

LOCK = ".sweep.lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock: a file that says which process on which host has it.

    It appears in one step, with its content, by a hard link. The lock of a process of this host
    that is gone is taken over; whether one of another host is still alive cannot be known.

    Raises
    ------
    RunFolderError
        If another sweep has it.
    """
    lock, own = folder / LOCK, folder / f"{LOCK}.{uuid.uuid4().hex}"
    try:
        own.write_text(json.dumps(_self()), encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"{folder}: cannot be written ({error}); choose another") from error
    try:
        try:
            os.link(own, lock)
        except FileExistsError:
            _take_over(lock, own)
    finally:
        own.unlink(missing_ok=True)
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)


def _take_over(lock: Path, own: Path) -> None:
    """Put our file in the place of a stale one.

    Two may find the same stale lock. Each lock is unique, and only who created the claim on it may
    replace it, and only if it is still there: so the second one never removes the first one's.
    """
    text, holder = _read(lock)
    if not _is_gone(holder):
        raise _in_use(lock, holder)
    claim = lock.with_name(f"{LOCK}.claim-{holder['token']}")
    try:
        os.link(own, claim)
    except FileExistsError:
        raise _in_use(claim, _read(claim)[1]) from None
    try:
        if _read(lock)[0] != text:
            raise _in_use(lock, _read(lock)[1])
        os.replace(own, lock)
    finally:
        claim.unlink(missing_ok=True)


def _in_use(lock: Path, holder: dict[str, Any]) -> RunFolderError:
    who = f"process {holder.get('pid', '?')} on {holder.get('host', '?')}"
    return RunFolderError(
        f"{lock.parent}: another sweep is at work here ({who}); wait for it, or remove {lock} if "
        "that process is gone"
    )


def _read(lock: Path) -> tuple[str, dict[str, Any]]:
    try:
        text = lock.read_text(encoding="utf-8")
        found = json.loads(text)
    except (OSError, ValueError):
        return "", {}
    return text, found if isinstance(found, dict) else {}


def _self() -> dict[str, Any]:
    pid = os.getpid()
    host, token = socket.gethostname(), uuid.uuid4().hex
    return {"pid": pid, "host": host, "begun": _begun(pid), "token": token}


def _is_gone(holder: dict[str, Any]) -> bool:
    """Return whether a process of this host certainly lives no more."""
    pid = holder.get("pid")
    if not isinstance(pid, int) or holder.get("host") != socket.gethostname():
        return False
    if "token" not in holder or os.name == "nt":  # there, signal 0 would end the process
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return _begun(pid) != holder.get("begun")  # another process has its number now


def _begun(pid: int) -> str:
    """When a process began, as far as that can be told: boot and clock ticks since then."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return f"{boot} {stat.rpartition(')')[2].split()[19]}"  # field 22; the name may hold blanks
