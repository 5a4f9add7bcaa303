"""A last sentence for a process that dies: an FMU that crashes in it leaves it no time for one."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import NoReturn

from workers.fmu.surroundings import before_first_instance

SENTENCE = (
    "cluster-est: this process has died: something in it has crashed or ended it, or it was "
    "killed from outside; --resume continues a run that was begun"
)
OF_FMU = (
    "cluster-est: this process has died: an FMU that runs in it has crashed, or it was killed from "
    'outside. With executor.name = "processes" each FMU has a process of its own, and a crash '
    "costs only its simulation; --resume continues a run that was begun"
)
SHELL = "/bin/sh"
FAREWELL, LOADED = b"farewell\n", b"loaded\n"
OBSERVE = (
    "trap '' HUP INT TERM; said=$0; while read -r word; do "
    'case "$word" in farewell) exit;; *) said=$1;; esac; done; printf \'%s\\n\' "$said" >&2'
)
"""Prints its first argument, or the second once it is told that an FMU is loaded, unless it is
told farewell before its input ends."""


@contextlib.contextmanager
def crash_observer() -> Iterator[None]:
    """Print a sentence to standard error if this process dies within the context.

    It speaks of FMUs only if one has been loaded in this process.

    A shell waits for a farewell from this process; the system closes the pipe if it dies. Where
    there is no such shell nothing is printed.
    """
    try:
        observer = subprocess.Popen(
            [SHELL, "-c", OBSERVE, SENTENCE, OF_FMU],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is not meant for it
        )
    except OSError:
        yield
        return
    assert observer.stdin is not None
    told = observer.stdin

    def tell() -> None:
        with contextlib.suppress(OSError, ValueError):  # it was killed
            told.write(LOADED)
            told.flush()

    before_first_instance(tell)
    try:
        yield
    finally:
        observer.communicate(FAREWELL)


def refuse_quiet_ends(code: int) -> None:
    """Have this process end with this exit code if anybody but `end` ends it in order.

    An FMU that calls exit(0) would have a command look as if it had succeeded. From then on only
    `end` may end this process. The C library calls what is given here, last first: no code of
    Python's, because there may be no interpreter any more.
    """
    if sys.platform == "win32":
        return
    library = ctypes.CDLL(None)
    register = library.__cxa_atexit
    register.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    for function, argument in ((library._exit, code), (library.fflush, None)):
        register(ctypes.cast(function, ctypes.c_void_p), argument, None)


def end(code: int, *, in_order: bool = True) -> NoReturn:
    """End this process with an exit code, whatever libraries would do at its end.

    Parameters
    ----------
    code
        The exit code.
    in_order
        Whether what is registered with `atexit` comes first.
    """
    if in_order:
        atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):  # a program may have neither
        with contextlib.suppress(OSError, ValueError):  # nobody reads it any more
            stream.flush()
    os._exit(code)
