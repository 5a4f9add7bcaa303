"""A last sentence for a process that dies: an FMU that crashes in it leaves it no time for one."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator

SENTENCE = (
    "cluster-est: this process has died: an FMU that runs in it has crashed, or it was killed from "
    'outside. With executor.name = "processes" each FMU has a process of its own, and a crash '
    "costs only its simulation; a run that was begun goes on with --resume"
)
SHELL = "/bin/sh"
OBSERVE = "trap '' HUP INT TERM; read -r farewell || printf '%s\\n' \"$0\" >&2"
"""Prints its first argument unless it is told farewell before its input ends."""


@contextlib.contextmanager
def crash_observer(sentence: str = SENTENCE) -> Iterator[None]:
    """Print a sentence to standard error if this process dies within the context.

    A shell waits for a farewell from this process; the system closes the pipe if it dies. Where
    there is no such shell nothing is printed.
    """
    try:
        observer = subprocess.Popen(
            [SHELL, "-c", OBSERVE, sentence],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is not meant for it
        )
    except OSError:
        yield
        return
    try:
        yield
    finally:
        observer.communicate(b"\n")
