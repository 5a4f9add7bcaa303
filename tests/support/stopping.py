"""Workers that stand still again and again, as on a machine that is busy with other things."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

import pytest

from workers.process.forked import ForkClient

STOPPED, RUNNING = 0.3, 0.1
"""Seconds of each."""


@contextlib.contextmanager
def stopped_now_and_then(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Stop every process that is forked for an FMU, and let it go on, over and over.

    Gives their ids. Each stands still for three times as long as it runs in between.
    """
    processes: list[int] = []
    fork = ForkClient.fork

    def noted(client: ForkClient, *, effects: bool = False):
        process, connection = fork(client, effects=effects)
        processes.append(process)
        return process, connection

    ended = threading.Event()

    def send(number: int) -> None:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, number)

    def go_on() -> None:
        while not ended.is_set():
            send(signal.SIGSTOP)
            ended.wait(STOPPED)
            send(signal.SIGCONT)
            ended.wait(RUNNING)

    with monkeypatch.context() as patched:
        patched.setattr(ForkClient, "fork", noted)
        thread = threading.Thread(target=go_on)
        thread.start()
        try:
            yield processes
        finally:
            ended.set()
            thread.join()
