"""Codes and messages of simulations that do not reach their end."""

from __future__ import annotations

from workers.kernels.fmi.compiling import inlined

FINISHED = 0
INITIALISATION = 1
STEP = 2
OUTPUT = 3
STEP_TOO_SMALL = 4
TOO_MANY_STEPS = 5
NOT_FINITE = 6
EVENT = 7
TERMINATED = 8
CHATTERING = 10
DISCARDED = 11
PENDING = 12
SENSITIVITIES = 13
HAS_EVENTS = 14
ENDED_EARLY = 15

MESSAGES = {
    INITIALISATION: "the FMU could not be initialised",
    STEP: "the FMU could not go on",
    OUTPUT: "the FMU could not compute its outputs",
    STEP_TOO_SMALL: "no step was short enough for the tolerance",
    TOO_MANY_STEPS: "the limit on the steps between two times in the data, model.max_steps, "
    "was reached",
    NOT_FINITE: "an output became infinite or not a number",
    EVENT: "the FMU could not handle an event",
    CHATTERING: "events followed each other without end",
    DISCARDED: "the FMU could not go on",
    PENDING: "the FMU computes in the background, which is not supported",
    SENSITIVITIES: "the FMU could not give its directional derivatives",
    HAS_EVENTS: "an event was met, across which sensitivities cannot be carried",
    TERMINATED: "the FMU ended the simulation by itself",
    ENDED_EARLY: "its sum of squares was above the bound already",
}

SUGGEST_STIFFNESS = (STEP_TOO_SMALL, TOO_MANY_STEPS)
"""Codes that an explicit solver returns for a stiff model."""

FATAL = 100
"""Added to a code after status fatal: this instance must not be called any more."""


@inlined
def failed(code, status):  # type: ignore[no-untyped-def]
    """Return the code of a call that brought no result."""
    return code + FATAL if status >= 4 else code


@inlined
def failed_step(status):  # type: ignore[no-untyped-def]
    """Return the code of a failed communication step: the FMU may discard it, or be pending."""
    if status == 2:
        return DISCARDED
    return PENDING + FATAL if status == 5 else failed(STEP, status)
