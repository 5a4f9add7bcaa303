"""The environment of an FMU in its process: variables, working folder, memory and signal handlers.

Some FMUs replace the signal handlers of the process, so that Ctrl-C would have no effect.
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
"""Prefixes of environment variables that a process or library reads only at its start."""


def set_environment_here(model: Model) -> None:
    """Set an FMU's environment variables in this process, which also runs other code.

    They remain set.

    Raises
    ------
    ModelError
        If a variable already has another value, or cannot take effect after the start.
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
    """Change to an FMU's working folder in this process, which runs only this FMU.

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
    """Register a function that is called once before this process loads its next FMU."""
    _to_be_told.append(call)


def tell_of_first_instance() -> None:
    """Call the functions registered by `before_first_instance`."""
    while _to_be_told:
        _to_be_told.pop()()


def resident_bytes(process: int | str) -> int:
    """Return the bytes that a process has in memory; 0 if the system does not report it."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * 4096


KEPT_SIGNALS = tuple(
    int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
SIGACTION_BYTES = 512
"""Buffer size in bytes, larger than a struct sigaction on any system."""
_ADDRESS = ctypes.c_size_t
"""Type of the first field of a struct sigaction, the handler; the C library may set its flags."""
PAUSE = 0.05
"""Seconds for which an FMU's handlers may stay in place."""
_C_LIBRARY = ctypes.CDLL(None) if sys.platform != "win32" else None


class _SignalHandlers:
    """The signal handlers from before any thread called an FMU, kept while a thread calls one.

    Once an FMU has replaced them, a thread also restores them during later calls. Most such FMUs
    replace them at every initialisation, and Ctrl-C would then be lost in a slow simulation.
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
        """Save the handlers if no other thread is inside."""
        with self._lock:
            if self._inside == 0:
                for number, room, _ in self._places:
                    _sigaction(number, None, room)
            self._inside += 1
            if self._guard is not None:
                self._entered.set()

    def __exit__(self, *_: object) -> None:
        """Restore the handlers, and start a guard thread if they had been replaced."""
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
        """Restore the handlers; return whether they had been replaced."""
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
    """Return a context at whose end the signal handlers are the same as at its beginning.

    In Python, only the main thread could restore them, and changes by C code are invisible. If
    several threads are inside, the handlers of the first thread's beginning are restored. A later
    thread might otherwise save an FMU's handlers. From the second time on that an FMU replaces
    them, they are also restored while it runs.
    """
    return contextlib.nullcontext() if _C_LIBRARY is None else _BEFORE
