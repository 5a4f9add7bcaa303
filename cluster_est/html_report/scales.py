"""Scales of charts: positions of values in a plot, and their ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self, final

import numpy as np

from cluster_est.html_report.number_text import MINUS
from workers.messages import FloatArray

PLOT_UNITS = 10_000
"""Number of positions across a plot, fine enough to read back values with four digits."""

LOG_FROM = 10.0
"""A scale is logarithmic, if allowed, when the ratio of its ends is above this value."""

LEAST_TICKS = 2

MORE = 1.35
"""A scale may have up to this multiple of the requested number of parts. A smaller multiple could
give less than half of the requested number."""


@final
@dataclass(frozen=True)
class Scale:
    """The values at both ends of a plot, with a linear or logarithmic scale between them.

    Attributes
    ----------
    low, high
        Different from each other; both positive if `log`.
    log
        Whether the scale is logarithmic.
    """

    low: float
    high: float
    log: bool = False

    @classmethod
    def around(
        cls,
        *values: FloatArray,
        margin: float = 0.04,
        may_be_log: bool = False,
        least: float = 0.0,
    ) -> Self:
        """Return a scale that contains all finite values, with a margin as a share of their range.

        Its range is at least the share `least` of the largest value, so that small differences of
        large numbers look small.
        """
        known = np.concatenate([np.ravel(each) for each in values]) if values else np.zeros(0)
        known = known[np.isfinite(known)]
        if not len(known):
            return cls(0.0, 1.0)
        low, high = float(known.min()), float(known.max())
        if may_be_log and low > 0.0 and high / low > LOG_FROM:
            wider = (high / low) ** margin
            return cls(low / wider, high * wider, log=True)
        if high - low <= 1e-12 * max(abs(low), abs(high)):  # the range is only rounding
            wider = 0.5 * abs(high) or 1.0
            return cls(low - wider, high + wider)
        missing = max(0.0, least * max(abs(low), abs(high)) - (high - low))
        wider = margin * (high - low) + 0.5 * missing
        return cls(low - wider, high + wider)

    def places(self, values: FloatArray) -> FloatArray:
        """Return positions from 0 at the low end to `PLOT_UNITS` at the high end; NaN stays NaN."""
        if self.log:
            with np.errstate(all="ignore"):
                shares = np.log(values / self.low) / math.log(self.high / self.low)
            return np.asarray(PLOT_UNITS * np.where(np.isfinite(shares), shares, np.nan))
        return np.asarray(PLOT_UNITS * (values - self.low) / (self.high - self.low))

    def ticks(self, count: int) -> tuple[tuple[float, str], ...]:
        """Return about `count` round values between both ends, at least two, with their labels."""
        if self.log:
            return self._powers(count)
        values: list[float] = []
        while len(values) < LEAST_TICKS:  # a single tick does not define the scale
            step = nice_step(self.high - self.low, count)
            first, last = math.ceil(self.low / step), math.floor(self.high / step)
            values = [step * number for number in range(first, last + 1)]
            count += 1
        return tuple((value, tick_text(value, step)) for value in values)

    def _powers(self, count: int) -> tuple[tuple[float, str], ...]:
        """Return powers of ten, with 2 and 5 between them if there is space."""
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        for leading in ((1, 2, 5), (1, 3), (1,)):
            found = [m * 10.0**power for power in range(first, last + 1) for m in leading]
            found = [value for value in found if self.low <= value <= self.high]
            if len(found) <= count + 1:
                break
        found = found[:: max(1, math.ceil(len(found) / (count + 1)))]
        return tuple((value, f"{value:g}".replace("-", MINUS)) for value in found)


def nice_step(span: float, count: int) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that gives about `count` parts."""
    raw = span / (MORE * max(1, count))
    power = 10.0 ** math.floor(math.log10(raw))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= raw * (1.0 - 1e-9))


def tick_text(value: float, step: float) -> str:
    """Return a multiple of a step with enough digits to distinguish it from the next one."""
    if abs(value) < 1e-9 * step:
        return "0"
    size = max(abs(value), step)
    if 1e-3 <= size < 1e5 and step >= 1e-6:
        text = f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"
    else:
        digits = math.floor(math.log10(size) + 1e-9) - math.floor(math.log10(step) + 1e-9)
        mantissa, _, exponent = f"{value:.{digits}e}".partition("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", MINUS)
