"""A heartbeat: updates of the display of a run while no outcomes arrive."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from cluster_est.methods.method import Progress
from cluster_est.running.resources import RunSnapshot, Show

SECONDS_BETWEEN_BEATS = 1.0
STARTING = "starting"
"""Text in place of a search's name before the first search."""


@contextmanager
def beating(show: Show, seconds: float = SECONDS_BETWEEN_BEATS) -> Iterator[Show]:
    """Show the last state of a run again, with updated seconds, if no new state arrives.

    The remaining time in such a state is unknown. The display begins before the first simulation.

    Parameters
    ----------
    show
        Called with each state, from one thread at a time.
    seconds
        Seconds between two beats.
    """
    lock, ended = threading.Lock(), threading.Event()
    shown = time.monotonic()
    last = RunSnapshot(STARTING, Progress(0, math.nan), 0, 0, 0, 0, 1, 0.0)

    def forward(snapshot: RunSnapshot) -> None:
        nonlocal last, shown
        with lock:
            last, shown = snapshot, time.monotonic()
            show(snapshot)

    def beat() -> None:
        while not ended.wait(seconds):
            with lock:
                passed = time.monotonic() - shown
                if passed >= seconds:
                    since = last.seconds + passed
                    show(replace(last, seconds=since, left=math.nan, pace=math.nan))

    thread = threading.Thread(target=beat, name="beat", daemon=True)
    thread.start()
    try:
        yield forward
    finally:
        ended.set()
        thread.join()
