"""How compiled loops note their progress; see `workers.messages.types`.

What is noted with every call of a cheap FMU is a constant, which whoever looks erases: to store one
costs nothing that can be measured beside the call, while to count calls made the cheapest
simulations a quarter longer.
"""

from __future__ import annotations

from workers.kernels.fmi.compiling import inlined
from workers.messages.types import CALLED, RUNNING, SIMULATIONS, STEPS


@inlined
def note_call(work):  # type: ignore[no-untyped-def]
    """Note that the FMU is told where it is, or to make a step."""
    work.progress[CALLED] = 1


@inlined
def count_simulation(work):  # type: ignore[no-untyped-def]
    """Count a simulation that begins; the caller of the loop says when the last one has ended."""
    work.progress[SIMULATIONS] += 1
    work.progress[RUNNING] = 1


@inlined
def note_steps(work, steps):  # type: ignore[no-untyped-def]
    """Note how many steps the solver has made in a simulation, at its end."""
    work.progress[STEPS] = steps
