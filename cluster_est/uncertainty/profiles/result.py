"""The profile of an unknown, and why it may have no end."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from workers.messages.equality import by_content


class ProfileEnd(enum.StrEnum):
    """The end of one side of a profile, or why there is none; the texts of the tables."""

    FOUND = ""
    BOUND = "bound"
    FLAT = "flat"
    FAILED = "failed"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class ProfilePoint:
    """A refit: the fixed value, the cost, and all unknowns, in physical units.

    `root` is the signed root of the rise of the cost, -1 and 1 at the ends of the interval.
    """

    value: float
    cost: float
    root: float
    estimates: tuple[float, ...]


@by_content
@dataclass(frozen=True)
class ProfileResult:
    """The profile of one unknown.

    Attributes
    ----------
    label, value, cost
        Of the unknown: its label, its estimate and the cost there.
    rise, confidence
        Of the cost at the ends of the interval, and their confidence.
    points
        From low to high values, the optimum among them; `labels` are those of their estimates.
    lower, upper
        The ends of the interval, in physical units. Where there is none they are infinite, or NaN
        if refits failed, and `open_lower` or `open_upper` says why: "bound" if the profile reaches
        the unknown's bound first, "flat" if it never rises enough, "failed" if refits failed,
        "unknown" if the residuals do not determine how far the cost may rise.
    better
        (estimates, cost) of a point that is better than the optimum; None if there is none.
    """

    label: str
    value: float
    cost: float
    rise: float
    confidence: float
    labels: tuple[str, ...] = field(repr=False)
    points: tuple[ProfilePoint, ...] = field(repr=False)
    lower: float
    upper: float
    open_lower: ProfileEnd
    open_upper: ProfileEnd
    better: tuple[dict[str, float], float] | None = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on missing ends, and on a better minimum."""
        ends = [
            ("lower", self.open_lower, self.points[0]),
            ("upper", self.open_upper, self.points[-1]),
        ]
        if self.open_lower is ProfileEnd.UNKNOWN:
            return (
                f"{self.label} has no profile, because the residuals do not say how far the cost "
                "may rise; give uncertainty.rise",
            )
        found = [
            _sentence(self.label, side, end, point.value)
            for side, end, point in ends
            if end is not ProfileEnd.FOUND
        ]
        if self.better is not None:
            found.append(
                f"{self.label}: while its profile was taken, a better minimum turned up (cost "
                f"{self.better[1]:.6g} instead of {self.cost:.6g}); fit again from there"
            )
        return tuple(found)


def _sentence(label: str, side: str, end: ProfileEnd, value: float) -> str:
    if end is ProfileEnd.BOUND:
        return f"{label} has no {side} limit: its profile reaches the bound {value:.6g} first"
    if end is ProfileEnd.FLAT:
        return f"{label} has no {side} limit: the cost does not rise enough as far as {value:.6g}"
    return f"{label} has no {side} limit: the refits beyond {value:.6g} failed, or were cut off"
