"""Own states of effects: how many steps they take where nothing else controls their error."""

from __future__ import annotations

from math import ceil

from workers.kernels.fmi.compiling import inlined

SUBSTEPS = 8.0
"""Runge-Kutta steps for each time constant."""
MOST_SUBSTEPS = 10_000.0


@inlined
def substep_count(length, rate):  # type: ignore[no-untyped-def]
    """Return the steps that an interval of this length takes, at the rate of the fastest state."""
    return int(min(max(1.0, ceil(SUBSTEPS * length * rate)), MOST_SUBSTEPS))
