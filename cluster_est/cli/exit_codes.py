"""How a command ends, for the shell."""

from __future__ import annotations

import enum


class ExitCode(enum.IntEnum):
    """What a command returns."""

    DONE = 0
    NO_SOLUTION = 1
    """It ran, but did not reach a solution."""
    BAD_INPUT = 2
    """Something must be mended first; a sentence says what."""
    INTERRUPTED = 130
