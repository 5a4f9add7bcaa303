"""The settings of multiple shooting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

from pydantic import Field, model_validator

from cluster_est.errors import ProblemError
from cluster_est.problem.problem import Problem
from cluster_est.settings import Finite, Settings, sentence
from workers.messages.checks import shown

LEAST_SAMPLES = 4
"""Of a segment that is cut in halves."""


class Shooting(Settings):
    """The segments that each training record is cut into: their number, or their length."""

    section: ClassVar[str] = "method.shooting"

    segments: int | None = Field(
        None,
        ge=2,
        description="parts that each training record is cut into; fewer where it has fewer "
        "measured times",
    )
    length: Finite | None = Field(None, gt=0.0, description="seconds of a part at most, instead")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.segments is None) == (self.length is None):
            given = "neither" if self.segments is None else "both"
            raise sentence(
                f"{self.section}: must have segments or length, but has {given}; write "
                "{ segments = 20 }, or { length = 0.5 } for seconds"
            )
        return self

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
            return cls(**given)
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
