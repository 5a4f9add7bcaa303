"""Whether a run came to something that one may build on, as pages and exit codes say it."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from typing import Any


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
        See `doubts_of`.
    """
    if status != RunStatus.DONE:
        return RunWorth.BAD
    return RunWorth.DOUBTFUL if doubts else RunWorth.GOOD


def doubts_of(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what is doubtful of a fit by its run.json; earlier versions know its intervals alone.

    Parameters
    ----------
    facts
        Of run.json.
    """
    if "doubts" in facts:
        return tuple(facts["doubts"] or ())
    narrow = (facts.get("residuals") or {}).get("too_narrow")
    return ("its intervals are too narrow",) if narrow else ()
