"""Messages of FMUs, collected for each instance."""

from __future__ import annotations

import ctypes
import sys
import weakref
from collections import deque
from collections.abc import Callable

_logs: weakref.WeakValueDictionary[str, deque[str]] = weakref.WeakValueDictionary()
_shown: set[str] = set()
"""Instances whose messages are shown."""
_STATUSES = ("ok", "warning", "discard", "error", "fatal", "pending")


def _log(_environment: object, instance: bytes, status: int, _category: bytes, text: bytes) -> None:
    """Receive a message from any instance; fmpy's proxy knows one logger for all of them."""
    _append((instance or b"").decode(errors="replace"), status, text)


def open_log(name: str, log: deque[str], *, shown: bool) -> None:
    """Collect the messages of an instance in `log`, for as long as that is in use.

    If `shown`, they go to stderr too.
    """
    _logs[name] = log
    if shown:
        _shown.add(name)


def log_message_3(name: str) -> Callable[[object, int, bytes, bytes], None]:
    """Return a function that receives the messages of one instance of FMI 3.0."""
    return lambda _environment, status, _category, text: _append(name, status, text)


def _append(name: str, status: int, message: bytes) -> None:
    text = (message or b"").decode(errors="replace").strip()
    log = _logs.get(name.strip())
    if log is None and len(_logs) == 1:  # some FMUs name no instance, or another one
        log = next(iter(_logs.values()), None)
    if log is not None and status > 0:
        log.append(text)
    if name in _shown:
        of = _STATUSES[status] if 0 <= status < len(_STATUSES) else str(status)
        sys.stderr.write(f"{of}: {text}\n")
        sys.stderr.flush()  # the next call may end the process


def make_callbacks() -> ctypes.Structure:
    """Make the callbacks of FMI 2.0, and the logger of all its instances in this process."""
    from ctypes import byref

    from fmpy import calloc, free
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )
    from fmpy.logging import addLoggerProxy

    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(_log)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    addLoggerProxy(byref(callbacks))
    return callbacks  # type: ignore[no-any-return]


CALLBACKS = make_callbacks()
"""Of FMI 2.0, for all instances."""
