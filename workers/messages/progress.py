"""Progress that a simulation notes, for whoever waits for it in another process.

It says that the simulation goes on, whatever the clock says.
"""

from __future__ import annotations

import numpy as np

from workers.messages.types import IntArray

CALLED, SIMULATIONS, RUNNING, STEPS = range(4)
"""Whether the FMU was told where it is, or to make a step, since somebody looked; how many
simulations have begun; whether one of them is under way; and the steps of the solver in the last
one that reached its end."""


def no_watcher() -> IntArray:
    """Progress that nobody looks at."""
    return np.zeros(4, np.int64)
