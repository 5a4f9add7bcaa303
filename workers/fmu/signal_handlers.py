"""The process's own handlers of signals, which some FMUs replace: Ctrl-C would do nothing."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import sys
from collections.abc import Iterator

KEPT = (signal.SIGINT, signal.SIGTERM)
ROOM = 512
"""Bytes: more than a struct sigaction has on any system."""
_C_LIBRARY = ctypes.CDLL(None) if sys.platform != "win32" else None


@contextlib.contextmanager
def kept_signal_handlers() -> Iterator[None]:
    """Put the handlers back at the end that were there at the beginning.

    From Python only the main thread could, and would not see what C code has changed.
    """
    if _C_LIBRARY is None:
        yield
        return
    sigaction = _C_LIBRARY.sigaction
    before = {number: ctypes.create_string_buffer(ROOM) for number in KEPT}
    for number, room in before.items():
        sigaction(int(number), None, room)
    try:
        yield
    finally:
        for number, room in before.items():
            sigaction(int(number), room, None)
