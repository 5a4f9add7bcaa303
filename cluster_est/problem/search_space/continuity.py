"""Continuity of states between segments of a record, as residuals of a search.

Where a record is cut into segments that are simulated on their own, the state s_k that a segment
begins with is an unknown, and the one before must end in it:

    r = w (s_k - x_end) / scale.

Like a prior, this is known from the point and from what a worker has sent, and needs no simulation:
a worker sends x_end as the residual of an output that is compared with a value of no meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from workers.messages import FloatArray, IntArray


@dataclass(frozen=True)
class StateEnd:
    """One state at the end of a segment, and the unknown that it must be equal to.

    Attributes
    ----------
    experiment
        Position, in the space, of the segment that ends.
    row
        Among the residuals of that segment's outputs: (compared - x_end) / sigma.
    compared, sigma
        Of that residual.
    unknown
        The state that the next segment begins with.
    scale
        Of the difference, in the state's unit.
    """

    experiment: int
    row: int
    compared: float
    sigma: float
    unknown: int
    scale: float


@dataclass(frozen=True)
class StateContinuity:
    """All ends of the segments of a space.

    Attributes
    ----------
    ends
        In the order of the space's experiments.
    weight
        w: how much a difference counts.
    """

    ends: tuple[StateEnd, ...] = field(repr=False)
    weight: float = 1.0

    @cached_property
    def of_experiment(self) -> dict[int, _EndRows]:
        """By position of the segment that ends."""
        found: dict[int, list[StateEnd]] = {}
        for end in self.ends:
            found.setdefault(end.experiment, []).append(end)
        return {e: _EndRows.of(ends) for e, ends in found.items()}

    def acting(self, e: int) -> list[int]:
        """The unknowns that a segment must end in."""
        rows = self.of_experiment.get(e)
        return [] if rows is None else rows.unknowns.tolist()

    def applied(self, e: int, x: FloatArray, residuals: FloatArray) -> FloatArray:
        """The residuals of a segment, with differences of states in their places."""
        rows = self.of_experiment.get(e)
        if rows is None:
            return residuals
        result = residuals.copy()
        result[rows.rows] = self.weight * rows.differences(x, residuals) / rows.scales
        return result

    def differences(self, applied: Sequence[FloatArray]) -> FloatArray:
        """(ends,): s_k - x_end, from what `applied` has made of the residuals of each segment."""
        parts = [applied[e][rows.rows] for e, rows in sorted(self.of_experiment.items())]
        return np.concatenate([np.zeros(0), *parts]) * self.scales / self.weight

    @cached_property
    def scales(self) -> FloatArray:
        """(ends,): in the order of `differences`."""
        parts = [rows.scales for _, rows in sorted(self.of_experiment.items())]
        return np.concatenate([np.zeros(0), *parts])


@dataclass(frozen=True)
class _EndRows:
    """The ends of one segment, as arrays."""

    rows: IntArray
    compared: FloatArray
    sigmas: FloatArray
    unknowns: IntArray
    scales: FloatArray

    @classmethod
    def of(cls, ends: Sequence[StateEnd]) -> _EndRows:
        return cls(
            np.array([end.row for end in ends], np.intp),
            np.array([end.compared for end in ends]),
            np.array([end.sigma for end in ends]),
            np.array([end.unknown for end in ends], np.intp),
            np.array([end.scale for end in ends]),
        )

    def differences(self, x: FloatArray, residuals: FloatArray) -> FloatArray:
        reached = self.compared - self.sigmas * residuals[self.rows]
        return np.asarray(x[self.unknowns] - reached)
