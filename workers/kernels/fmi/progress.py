"""Counters that a simulation advances, for whoever waits for it in another process.

They say that it goes on, whatever the clock says: each is one store to memory that stays in the
cache, beside several calls of the FMU.
"""

from __future__ import annotations

import numpy as np

from workers.kernels.fmi.calling import inlined
from workers.messages import IntArray

CALLS, SIMULATIONS, RUNNING = range(3)
"""How often the FMU was told where it is, or to make a step; how many simulations have begun; and
whether one of them is under way."""


def no_watcher() -> IntArray:
    """Counters that nobody looks at."""
    return np.zeros(3, np.int64)


@inlined
def count_call(work):  # type: ignore[no-untyped-def]
    """Count that the FMU was told where it is, or to make a step."""
    work.progress[CALLS] += 1


@inlined
def count_simulation(work):  # type: ignore[no-untyped-def]
    """Count a simulation that begins; the caller of the loop says when the last one has ended."""
    work.progress[SIMULATIONS] += 1
    work.progress[RUNNING] = 1
