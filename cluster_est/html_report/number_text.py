"""Numbers for readers: with significant digits only, and times in suitable units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

MINUS, NO_NUMBER = "\u2212", "\u2013"
FIXED_FROM, FIXED_TO = 1e-4, 1e6
"""Limits between which numbers are written without an exponent."""


def digits(value: float | None, count: int = 4) -> str:
    """Return a number with `count` significant digits; a dash for a missing number."""
    if value is None or math.isnan(value):
        return NO_NUMBER
    if math.isinf(value):
        return "\u221e" if value > 0.0 else f"{MINUS}\u221e"
    if value == 0.0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if not FIXED_FROM <= abs(value) < FIXED_TO:
        mantissa, _, exponent = f"{value:.{count - 1}e}".partition("e")
        return _signed(f"{mantissa}e{int(exponent)}")
    return _signed(f"{value:.{max(0, count - 1 - size)}f}")


def compact(value: float) -> str:
    """Return a number with three digits and without trailing zeros, for values like bounds."""
    return digits(value) if math.isinf(value) else _signed(f"{value:.3g}")


def beside(value: float | None, width: float) -> str:
    """Return a number with two digits of its interval's width, and at least four digits."""
    if value is None or not math.isfinite(value) or not 0.0 < width < math.inf:
        return digits(value)
    if value == 0.0:
        return "0"
    found = math.floor(math.log10(abs(value))) - math.floor(math.log10(width)) + 2
    return digits(value, min(max(found, 4), 9))


def interval(low: float | None, high: float | None) -> str:
    """Return the two ends of an interval; a dash for a missing end."""
    if low is None or high is None or math.isnan(low) or math.isnan(high):
        return NO_NUMBER
    width = high - low
    return f"{beside(low, width)} \u2026 {beside(high, width)}"


def count(value: float) -> str:
    """Return an integer with separated thousands."""
    return f"{value:,.0f}".replace(",", "\u202f")


def percent(share: float | None, count: int = 3) -> str:
    """Return a share in per cent, with `count` significant digits."""
    if share is None or math.isnan(share):
        return NO_NUMBER
    said = digits(100.0 * share, count if abs(share) < 10.0 else 4)
    if 0.0 < share < 1.0 and said.startswith("100"):  # a part is never rounded up to all of it
        return percent(share, count + 1) if count < 6 else "more than 99.9\u2009%"
    return f"{said}\u2009%"


def duration(seconds: float) -> str:
    """Return a duration in a suitable unit."""
    if seconds < 60.0:
        return f"{digits(seconds, 3)} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min"


def _signed(text: str) -> str:
    return text.replace("-", MINUS)


@final
@dataclass(frozen=True)
class TimeUnit:
    """A unit of time: its name, and its length in seconds."""

    name: str
    seconds: float


TIME_UNITS = (
    (0.1, TimeUnit("ms", 1e-3)),
    (300.0, TimeUnit("s", 1.0)),
    (5.0 * 3600.0, TimeUnit("min", 60.0)),
    (4.0 * 86400.0, TimeUnit("h", 3600.0)),
)
"""Units of time, with the largest span in seconds for which each is used."""
DAYS = TimeUnit("days", 86400.0)


def time_unit(span: float) -> TimeUnit:
    """Return the unit for times with a span in seconds."""
    return next((unit for most, unit in TIME_UNITS if span <= most), DAYS)
