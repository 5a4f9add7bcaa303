"""The process's own handlers of signals, which some FMUs replace: Ctrl-C would do nothing."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

KEPT = (signal.SIGINT, signal.SIGTERM)
ROOM = 512
"""Bytes: more than a struct sigaction has on any system."""
_C_LIBRARY = ctypes.CDLL(None) if sys.platform != "win32" else None


class _HandlersAtTheBeginning:
    """The handlers before any thread has called an FMU, as long as one does."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.inside = 0
        self.handlers: dict[signal.Signals, Any] = {}


_BEFORE = _HandlersAtTheBeginning()


@contextlib.contextmanager
def kept_signal_handlers() -> Iterator[None]:
    """Put the handlers back at the end that were there at the beginning.

    From Python only the main thread could, and would not see what C code has changed. Where several
    threads are inside, the beginning is that of the first: a later one would take an FMU's handlers
    for those of the process.
    """
    if _C_LIBRARY is None:
        yield
        return
    sigaction = _C_LIBRARY.sigaction
    with _BEFORE.lock:
        if _BEFORE.inside == 0:
            _BEFORE.handlers = {number: ctypes.create_string_buffer(ROOM) for number in KEPT}
            for number, room in _BEFORE.handlers.items():
                sigaction(int(number), None, room)
        _BEFORE.inside += 1
    try:
        yield
    finally:
        with _BEFORE.lock:
            _BEFORE.inside -= 1
            for number, room in _BEFORE.handlers.items():
                sigaction(int(number), room, None)
