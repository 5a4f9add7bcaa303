"""Times, probabilities and lists as one would write them.

Reports of every kind say these, so nothing is imported here that is slow to load.
"""

from __future__ import annotations

from collections.abc import Sequence

NO_ALTERNATIVE = (
    "were the rest of the model exact, there would be very strong evidence against all else that "
    "was tried"
)
"""What is said of an effect without alternatives; a criterion takes models for exact."""


def readable_time(seconds: float) -> str:
    """Write a time in the unit in which it is easy to read: "3.2 s", "4.5 min", "24 h", "3 d"."""
    for unit, size, most in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < most:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 86_400.0:.3g} d"


def percent(probability: float) -> str:
    """Write a probability in percent, with no more certainty than it has."""
    if probability > 0.99:
        return "more than 99 %"
    return "less than 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def in_a_row(words: Sequence[str]) -> str:
    """Write words with commas, and "and" before the last one."""
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]
