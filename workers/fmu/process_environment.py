"""What an FMU finds around it in its process, and what it may change there.

It finds environment variables, a working folder and the memory. Some FMUs replace the process's own
handlers of signals: Ctrl-C would do nothing.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from workers.errors import ModelError
from workers.fmu.archive import unpack
from workers.messages import Model

READ_AT_START = (
    *("LD_", "DYLD_", "MALLOC_", "GLIBC_", "PYTHON"),
    *("OPENBLAS_", "OMP_", "MKL_"),
)
"""How environment variables begin that a process, or a library, reads only when it starts."""


def set_environment_here(model: Model) -> None:
    """Set an FMU's environment variables in this process, which is not the FMU's alone.

    They stay set, for whatever else is in it.

    Raises
    ------
    ModelError
        If one is something else already, or would come too late.
    """
    elsewhere = 'choose executor.name = "processes" or "ray"'
    for name, value in model.environment:
        known = os.environ.get(name)
        if known == value:
            continue
        if known is not None:
            raise ModelError(
                f"model.environment.{name}: must be {value!r}, but is already {known!r} in this "
                f"process, which also runs simulations; {elsewhere}, or unset it before the start"
            )
        if name.startswith(READ_AT_START):
            raise ModelError(
                f"model.environment.{name}: must be set before a process starts, but this process, "
                f"which also runs simulations, has already started; {elsewhere}, or set it before "
                "the start"
            )
    os.environ.update(model.environment)


def enter_working_folder(model: Model) -> None:
    """Make an FMU's working folder that of this process, which must be the FMU's alone.

    Raises
    ------
    ModelError
        If the FMU has no such folder, or cannot be unpacked.
    """
    if not model.working_folder:
        return
    folder = unpack(model.name, model.archive, model.archive_hash) / model.working_folder
    try:
        os.chdir(folder)
    except OSError as error:
        raise ModelError(
            f'model.working_folder: must be a folder in {model.name}, such as "resources", but is '
            f"{model.working_folder!r} ({error.strerror}); look for its folders in the FMU, which "
            "is a zip file"
        ) from error


_to_be_told: list[Callable[[], None]] = []


def before_first_instance(call: Callable[[], None]) -> None:
    """Have something called before this process loads an FMU for the first time from now on."""
    _to_be_told.append(call)


def tell_of_first_instance() -> None:
    """Call who is to be told that an FMU is about to be loaded here."""
    while _to_be_told:
        _to_be_told.pop()()


def resident_bytes(process: int | str) -> int:
    """Bytes that a process has in memory; 0 where the system does not say."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * 4096


KEPT_SIGNALS = tuple(
    int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
SIGACTION_BYTES = 512
"""Bytes: more than a struct sigaction has on any system."""
_ADDRESS = ctypes.c_size_t
"""Of a struct sigaction what is first, the handler; its flags are the library's own."""
PAUSE = 0.05
"""Seconds for which an FMU's handlers may stay."""
_C_LIBRARY = ctypes.CDLL(None) if sys.platform != "win32" else None


class _SignalHandlers:
    """The handlers before any thread has called an FMU, as long as one does.

    Once an FMU has replaced them, a thread gives them back during further calls too: most FMUs that
    do it do so at every initialisation, and then Ctrl-C would be lost in a slow simulation.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._handlers, self._found = _rooms(), _rooms()
        self._places = [
            (number, ctypes.addressof(room), ctypes.addressof(self._found[number]))
            for number, room in self._handlers.items()
        ]
        self._entered = threading.Event()
        self._guard: threading.Thread | None = None

    def __enter__(self) -> None:
        """Remember the handlers, if no other thread is inside."""
        with self._lock:
            if self._inside == 0:
                for number, room, _ in self._places:
                    _sigaction(number, None, room)
            self._inside += 1
            if self._guard is not None:
                self._entered.set()

    def __exit__(self, *_: object) -> None:
        """Put the handlers back, and see to it that they are guarded if they were others."""
        with self._lock:
            self._inside -= 1
            replaced = self._put_back()
            if self._inside == 0 and self._guard is not None:
                self._entered.clear()
            if replaced and self._guard is None:
                if self._inside > 0:
                    self._entered.set()
                self._guard = threading.Thread(target=self._stay, name="signals", daemon=True)
                self._guard.start()

    def _put_back(self) -> bool:
        """Put the handlers back; return whether there were others."""
        replaced = False
        for number, room, found in self._places:
            _sigaction(number, room, found)
            replaced |= _ADDRESS.from_address(room).value != _ADDRESS.from_address(found).value
        return replaced

    def _stay(self) -> None:
        while True:
            self._entered.wait()
            with self._lock:
                if self._inside > 0:
                    self._put_back()
            time.sleep(PAUSE)


if _C_LIBRARY is not None:
    _sigaction = _C_LIBRARY.sigaction
    _sigaction.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]


def _rooms() -> dict[int, Any]:
    return {number: ctypes.create_string_buffer(SIGACTION_BYTES) for number in KEPT_SIGNALS}


_BEFORE = _SignalHandlers()


def kept_signal_handlers() -> contextlib.AbstractContextManager[None]:
    """Return a context that puts the handlers back at its end that were there at its beginning.

    From Python only the main thread could, and would not see what C code has changed. Where several
    threads are inside, the beginning is that of the first: a later one would take an FMU's handlers
    for those of the process. From the second time on that an FMU replaces them they are put back
    while it runs, too.
    """
    return contextlib.nullcontext() if _C_LIBRARY is None else _BEFORE
