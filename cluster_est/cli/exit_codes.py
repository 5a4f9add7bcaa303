"""Exit codes of the commands."""

from __future__ import annotations

import enum


class ExitCode(enum.IntEnum):
    """The exit code of a command."""

    DONE = 0
    NO_SOLUTION = 1
    """It ran, but did not reach a solution."""
    BAD_INPUT = 2
    """Something must be mended first; a sentence says what."""
    INTERRUPTED = 130
