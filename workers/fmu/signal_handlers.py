"""The process's own handlers of signals, which some FMUs replace: Ctrl-C would do nothing."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import sys
import threading
import time
from typing import Any

KEPT = tuple(
    int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
ROOM = 512
"""Bytes: more than a struct sigaction has on any system."""
ADDRESS = ctypes.sizeof(ctypes.c_void_p)
"""Bytes of a struct sigaction, its first, that are the handler; its flags are the library's own."""
PAUSE = 0.05
"""Seconds for which an FMU's handlers may stay."""
_C_LIBRARY = ctypes.CDLL(None) if sys.platform != "win32" else None


class _HandlersAtTheBeginning:
    """The handlers before any thread has called an FMU, as long as one does.

    Once an FMU has replaced them, a thread gives them back during further calls too: most FMUs that
    do it do so at every initialisation, and then Ctrl-C would be lost in a slow simulation.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._handlers = _rooms()
        self._found = _rooms()
        self._entered = threading.Event()
        self._guard: threading.Thread | None = None

    def __enter__(self) -> None:
        """Remember the handlers, if no other thread is inside."""
        with self._lock:
            if self._inside == 0:
                _read(self._handlers)
            self._inside += 1
            self._entered.set()

    def __exit__(self, *_: object) -> None:
        """Put the handlers back, and see to it that they are guarded if they were others."""
        with self._lock:
            self._inside -= 1
            replaced = self._put_back()
            if self._inside == 0:
                self._entered.clear()
            if replaced and self._guard is None:
                self._guard = threading.Thread(target=self._stay, name="signals", daemon=True)
                self._guard.start()

    def _put_back(self) -> bool:
        """Put the handlers back; return whether there were others."""
        replaced = False
        for number, room in self._handlers.items():
            found = self._found[number]
            _sigaction(number, room, found)
            replaced |= found[:ADDRESS] != room[:ADDRESS]
        return replaced

    def _stay(self) -> None:
        while True:
            self._entered.wait()
            with self._lock:
                if self._inside > 0:
                    self._put_back()
            time.sleep(PAUSE)


def _sigaction(number: int, given: Any, found: Any) -> None:
    if _C_LIBRARY is not None:
        _C_LIBRARY.sigaction(number, given, found)


def _rooms() -> dict[int, Any]:
    return {number: ctypes.create_string_buffer(ROOM) for number in KEPT}


def _read(rooms: dict[int, Any]) -> None:
    """Read the handlers of now."""
    for number, room in rooms.items():
        _sigaction(number, None, room)


_BEFORE = _HandlersAtTheBeginning()


def kept_signal_handlers() -> contextlib.AbstractContextManager[None]:
    """Return a context that puts the handlers back at its end that were there at its beginning.

    From Python only the main thread could, and would not see what C code has changed. Where several
    threads are inside, the beginning is that of the first: a later one would take an FMU's handlers
    for those of the process. From the second time on that an FMU replaces them they are put back
    while it runs, too.
    """
    return contextlib.nullcontext() if _C_LIBRARY is None else _BEFORE
