"""Whether a run came to something that one may build on, as pages and exit codes say it."""

from __future__ import annotations

import enum
from collections.abc import Sequence


class RunStatus(enum.StrEnum):
    """The state of a run, as run.json says it."""

    RUNNING = "running"
    DONE = "done"
    NOT_CONVERGED = "not converged"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


class RunWorth(enum.StrEnum):
    """What a run is worth."""

    GOOD = "good"
    DOUBTFUL = ""
    """It ended with a solution, and says what is doubtful of it."""
    BAD = "bad"


def run_worth(status: str, doubts: Sequence[str]) -> RunWorth:
    """Judge a fit by how it ended and by what is doubtful of its solution.

    Parameters
    ----------
    status
        Of the run.
    doubts
        What is doubtful of its solution, as its run.json or the summary of a sweep says it.
    """
    if status != RunStatus.DONE:
        return RunWorth.BAD
    return RunWorth.DOUBTFUL if doubts else RunWorth.GOOD
