"""The unit in which one thinks of a time span."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class TimeUnit:
    """A unit of time: how it is written, and its seconds."""

    name: str
    seconds: float


UNITS = (
    (0.1, TimeUnit("ms", 1e-3)),
    (300.0, TimeUnit("s", 1.0)),
    (5.0 * 3600.0, TimeUnit("min", 60.0)),
    (4.0 * 86400.0, TimeUnit("h", 3600.0)),
)
"""Each with the span in seconds up to which it is used."""
DAYS = TimeUnit("days", 86400.0)


def time_unit(span: float) -> TimeUnit:
    """The unit for times that span so many seconds."""
    return next((unit for most, unit in UNITS if span <= most), DAYS)
