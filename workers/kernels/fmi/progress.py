"""Progress that a simulation notes, for whoever waits for it in another process.

It says that the simulation goes on, whatever the clock says. What is noted with every call of a
cheap FMU is a constant, which whoever looks erases: to store one costs nothing that can be measured
beside the call, while to count calls made the cheapest simulations a quarter longer.
"""

from __future__ import annotations

import numpy as np

from workers.kernels.fmi.compiling import inlined
from workers.messages import IntArray

CALLED, SIMULATIONS, RUNNING = range(3)
"""Whether the FMU was told where it is, or to make a step, since somebody looked; how many
simulations have begun; and whether one of them is under way."""


def no_watcher() -> IntArray:
    """Progress that nobody looks at."""
    return np.zeros(3, np.int64)


@inlined
def note_call(work):  # type: ignore[no-untyped-def]
    """Note that the FMU is told where it is, or to make a step."""
    work.progress[CALLED] = 1


@inlined
def count_simulation(work):  # type: ignore[no-untyped-def]
    """Count a simulation that begins; the caller of the loop says when the last one has ended."""
    work.progress[SIMULATIONS] += 1
    work.progress[RUNNING] = 1
