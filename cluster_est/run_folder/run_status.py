"""The state of a run."""

from __future__ import annotations

import enum


class RunStatus(enum.StrEnum):
    """The state of a run, as run.json says it."""

    RUNNING = "running"
    DONE = "done"
    NOT_CONVERGED = "not converged"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
