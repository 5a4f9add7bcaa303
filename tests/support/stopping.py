"""Workers that stand still again and again, as on a machine that is busy with other things."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

from support.descendants import descendants

STOPPED, RUNNING = 0.3, 0.1
"""Seconds of each."""


@contextlib.contextmanager
def stopped_now_and_then() -> Iterator[set[int]]:
    """Stop every process that is there for an FMU, and let it go on, over and over.

    Gives the ids of all that there were. Each stands still for three times as long as it runs in
    between.
    """
    seen: set[int] = set()
    ended = threading.Event()

    def send(number: int) -> None:
        for process in seen:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)

    def go_on() -> None:
        while not ended.is_set():
            seen.update(descendants(3))
            send(signal.SIGSTOP)
            ended.wait(STOPPED)
            send(signal.SIGCONT)
            ended.wait(RUNNING)

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        yield seen
    finally:
        ended.set()
        thread.join()
