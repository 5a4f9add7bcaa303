"""The results of multiple shooting, for tables and notes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SURPRISING = 1e-3
"""Largest p-value of the cost increase by continuity for which there is a note."""


@dataclass(frozen=True)
class SegmentState:
    """One state at the start of one segment, a row of segments.parquet.

    `guess` is the start value of the search, and `value` is its result. `jump` is the difference
    between `value` and the end of the previous segment, in the state's unit. `relative_jump` is the
    jump over the state's standard deviation along the records.
    """

    experiment: str
    segment: int
    time: float
    state: str
    unit: str
    guess: float
    value: float
    jump: float
    relative_jump: float


@dataclass(frozen=True)
class ShootingSummary:
    """The course of a fit with segments.

    Attributes
    ----------
    segments
        Number of segments in all training records.
    joined
        Whether the fit was finished on whole records; otherwise all errors are those of segments.
    largest_jump
        Largest jump between two segments, over the standard deviation of the state; NaN if the
        segments could not be simulated.
    cost
        Cost of the segments, without their jumps.
    whole_cost
        Cost of the whole records at the result of the segments; NaN if one could not be simulated.
    asked
        Number of segments in the settings.
    promised
        Least ratio of a standard error from derivatives of whole records to that from segments.
    stopped
        Whether a budget or the user ended the search.
    free_cost, continuity_p
        Cost of the segments without continuity, and the p-value of its increase by continuity.
    left_out
        Requested results that need whole records and are missing.
    reason
        Why the segments failed; "" if they did not fail.
    states
        States at the start of each segment, except the first segment of each record.
    """

    segments: int
    joined: bool
    largest_jump: float
    cost: float
    whole_cost: float
    asked: int = 0
    promised: float = 1.0
    stopped: bool = False
    free_cost: float = np.nan
    continuity_p: float = 1.0
    left_out: tuple[str, ...] = ()
    reason: str = ""
    states: tuple[SegmentState, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """Notes for the user."""
        return (*self._followed, *self._by_jumps)

    @property
    def _by_jumps(self) -> tuple[str, ...]:
        """Return a note if the segments fitted their data only by jumps."""
        if self.continuity_p > SURPRISING:
            return ()
        return (
            f"the cost with free segments is {self.free_cost:.4g}, and with one trajectory it is "
            f"{self.cost:.4g}: noise does not explain the difference (p = "
            f"{self.continuity_p:.1g}). Either the search ended at a wrong point (try other "
            "starts or shorter segments), or the model lacks something, or an unmeasured "
            "disturbance acts on it (process noise)",
        )

    @property
    def _followed(self) -> tuple[str, ...]:
        if self.segments > self.asked > 0:
            shorter = (
                f"the records were cut into {self.segments} segments instead of {self.asked}, "
                f"because {self.asked} segments were too long to follow the data from the "
                "declared start",
            )
            return (*shorter, *self._ended)
        return self._ended

    @property
    def _ended(self) -> tuple[str, ...]:
        if self.reason:
            return (
                f"multiple shooting on {self.segments} segments failed ({self.reason}); the fit "
                "began at the declared start",
            )
        if self.joined:
            return (
                f"the fit began at the result of multiple shooting with {self.segments} segments, "
                f"which had a cost of {self.cost:.6g}",
            )
        return (
            f"estimates, errors and curves come from {self.segments} segments, each with an "
            "estimated initial state (segments.parquet); the largest jump between two segments is "
            f"{self.largest_jump:.2g} times the spread of that state; test records are simulated "
            "in one piece",
            self._whole,
            *(
                f"{name} was requested but is not computed, because it needs simulations of whole "
                "records, and the result of this fit holds for segments only"
                for name in self.left_out
            ),
        )

    @property
    def _whole(self) -> str:
        """Return the reason why the segments were not joined."""
        if self.stopped:
            return "the search with segments was stopped before it reached a solution"
        if not np.isfinite(self.whole_cost):
            return (
                "a training record cannot be simulated in one piece, because the model is unstable"
            )
        if self.promised < 1.0:
            return (
                f"in one piece, the records would give standard errors down to {self.promised:.2g} "
                "times those from the segments, as for a chaotic model. Such errors only describe "
                "the width of one minimum among very many, so they are not used"
            )
        return (
            "if the records are simulated in one piece from their start, the cost is "
            f"{self.whole_cost:.3g} instead of {self.cost:.3g}, as for a chaotic or unstable model"
        )
