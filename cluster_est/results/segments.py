"""What multiple shooting did, for tables and notes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SURPRISING = 1e-3
"""P-value of the price of continuity up to which something is said."""


@dataclass(frozen=True)
class SegmentState:
    """One state at the start of one segment, a row of segments.parquet.

    `guess` is what the search began with, `value` what it found, and `jump` what lies between the
    end of the segment before and that, in the state's unit; `relative_jump` is over the state's
    spread along the records.
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
    """How a fit went through segments.

    Attributes
    ----------
    segments
        Their number in all training records.
    joined
        Whether the fit was finished on whole records; else all errors are those of the segments.
    largest_jump
        Between two segments, over the spread of the state; NaN if nothing could be simulated.
    cost
        Of the segments, without their jumps.
    whole_cost
        Of the records as a whole at what the segments found; NaN where one could not be simulated.
    asked
        For how many the settings had asked.
    promised
        The least ratio of a standard error by the derivatives of whole records to that of the
        segments.
    stopped
        Whether a budget or the user ended the search.
    free_cost, continuity_p
        Of the segments while they need not follow each other, and the p-value of the rise since.
    left_out
        What was asked for and works on whole records alone.
    reason
        Why the segments led nowhere; "" if they did not fail.
    states
        At the start of each segment but the first of each record.
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
        """What a user should know of it."""
        return (*self._followed, *self._by_jumps)

    @property
    def _by_jumps(self) -> tuple[str, ...]:
        """That the segments followed their data by jumps, if they did."""
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
        """Why the segments were not joined."""
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
