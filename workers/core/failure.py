"""Codes of failed simulations, in the order of core.h, and their messages."""

from __future__ import annotations

(
    FINISHED, INITIALISATION, STEP, OUTPUT, STEP_TOO_SMALL, TOO_MANY_STEPS, NOT_FINITE, EVENT,
    TERMINATED, LINEARISATION, CHATTERING, DISCARDED, PENDING, SENSITIVITIES, HAS_EVENTS,
    ENDED_EARLY, NO_MEMORY, WRONG_SIZES, OUT_OF_STEPS,
) = range(19)  # fmt: skip
FATAL = 100
"""Added to a code after a fatal status: the instance must not be called again."""
DISCARD_STATUS, FATAL_STATUS = 2, 4
"""Statuses of FMU calls; from `DISCARD_STATUS` on, a call has no result."""

MESSAGES = {
    INITIALISATION: "the FMU could not be initialised",
    STEP: "the FMU could not continue",
    OUTPUT: "the FMU could not compute its outputs",
    STEP_TOO_SMALL: "even the shortest possible step did not meet the tolerance",
    TOO_MANY_STEPS: "the number of steps between two times in the data exceeded model.max_steps",
    NOT_FINITE: "an output became infinite or not a number",
    EVENT: "the FMU could not handle an event",
    TERMINATED: "the FMU ended the simulation by itself",
    LINEARISATION: "the FMU could not compute a point close to its trajectory",
    CHATTERING: "events followed each other without end",
    DISCARDED: "the FMU could not continue",
    PENDING: "the FMU computes asynchronously, which is not supported",
    SENSITIVITIES: "the FMU could not provide its directional derivatives",
    HAS_EVENTS: "an event occurred, and sensitivities cannot be continued across it",
    ENDED_EARLY: "the sum of squares had already exceeded the limit",
    NO_MEMORY: "there was not enough memory",
    WRONG_SIZES: "the FMU, its effects and the experiment have different numbers of states and "
    "inputs, which is a fault of cluster-est",
    OUT_OF_STEPS: "the simulation reached its limit of {limit} steps",
}

SUGGEST_STIFFNESS = (STEP_TOO_SMALL, TOO_MANY_STEPS)
"""Codes that an explicit solver returns for a stiff model."""
