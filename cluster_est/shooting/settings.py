"""The settings of multiple shooting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cluster_est.errors import ProblemError
from cluster_est.problem.problem import Problem
from workers.messages.checks import check_number, shown

LEAST_SAMPLES = 4
"""Of a segment that is cut in halves."""


@dataclass(frozen=True)
class Shooting:
    """Into how many segments each training record is cut, or how long one is at most.

    Attributes
    ----------
    segments
        Their number in each record; fewer where a record has fewer measured times.
    length
        In seconds, instead of a number.
    """

    segments: int | None = None
    length: float | None = None

    @classmethod
    def of(cls, given: Shooting | Mapping[str, Any] | None) -> Shooting | None:
        """Return what is given, also as in a config: {"segments": 20}.

        Raises
        ------
        ProblemError
            If it is something else.
        """
        if given is None or isinstance(given, cls):
            return given
        if isinstance(given, Mapping) and set(given) <= {"segments", "length"}:
            return cls(**dict(given))
        raise ProblemError(
            f"method.shooting: must have segments or length but is {shown(given)}; write "
            '{"segments": 20}, or {"length": 0.5} for seconds'
        )

    def halved(self, problem: Problem) -> Shooting | None:
        """Return the settings for segments half as long; None if they had too few samples."""
        longest = max(
            (e.stop - e.start) / max((len(o.times) for o in e.outputs), default=1)
            for e in problem.experiments
            if e.role == "train"
        )
        shortest = min(
            (e.stop - e.start) / self.segments if self.segments else self.length or 0.0
            for e in problem.experiments
            if e.role == "train"
        )
        if 0.5 * shortest < LEAST_SAMPLES * longest:
            return None
        if self.segments:
            return Shooting(segments=2 * self.segments)
        return Shooting(length=0.5 * (self.length or 0.0))

    def check(self) -> None:
        """Refuse what is neither or both.

        Raises
        ------
        ProblemError
            With what to write.
        """
        where = "method.shooting"
        if (self.segments is None) == (self.length is None):
            given = "neither" if self.segments is None else "both"
            raise ProblemError(
                f"{where}: must have segments or length, but has {given}; write "
                "{ segments = 20 }, or { length = 0.5 } for seconds"
            )
        if self.segments is not None:
            check_number(self.segments, f"{where}.segments", ProblemError, least=2, whole=True)
        if self.length is not None:
            check_number(self.length, f"{where}.length", ProblemError, above=0.0)
