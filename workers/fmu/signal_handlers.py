"""The process's own handlers of signals, which some FMUs replace: Ctrl-C would do nothing."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

KEPT = (signal.SIGINT, signal.SIGTERM)
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
        self._handlers: dict[signal.Signals, Any] = {}
        self._entered = threading.Event()
        self._guard: threading.Thread | None = None

    def enter(self) -> None:
        """Remember the handlers, if no other thread is inside."""
        with self._lock:
            if self._inside == 0:
                self._handlers = {number: _current(number) for number in KEPT}
            self._inside += 1
            self._entered.set()

    def leave(self) -> None:
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
        found = [_current(number).raw[:ADDRESS] for number in self._handlers]
        for number, room in self._handlers.items():
            _sigaction(number, room, None)
        return found != [room.raw[:ADDRESS] for room in self._handlers.values()]

    def _stay(self) -> None:
        while True:
            self._entered.wait()
            with self._lock:
                if self._inside > 0:
                    self._put_back()
            time.sleep(PAUSE)


def _sigaction(number: signal.Signals, given: Any, found: Any) -> None:
    if _C_LIBRARY is not None:
        _C_LIBRARY.sigaction(int(number), given, found)


def _current(number: signal.Signals) -> Any:
    room = ctypes.create_string_buffer(ROOM)
    _sigaction(number, None, room)
    return room


_BEFORE = _HandlersAtTheBeginning()


@contextlib.contextmanager
def kept_signal_handlers() -> Iterator[None]:
    """Put the handlers back at the end that were there at the beginning.

    From Python only the main thread could, and would not see what C code has changed. Where several
    threads are inside, the beginning is that of the first: a later one would take an FMU's handlers
    for those of the process. From the second time on that an FMU replaces them they are put back
    while it runs, too.
    """
    if _C_LIBRARY is None:
        yield
        return
    _BEFORE.enter()
    try:
        yield
    finally:
        _BEFORE.leave()
