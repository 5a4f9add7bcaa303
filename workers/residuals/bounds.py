"""Constraints on signals: how far each leaves what it is allowed."""

from __future__ import annotations

import numpy as np

from workers.messages import FloatArray, SignalBound
from workers.residuals.base import Comparison, ComparisonResult, SimulatedOutputs, positions


class SignalBounds(Comparison):
    """For each side of each bound the largest violation over its times; at most 0 if there is none.

    lower: max over t of (lower(t) - y(t)) / scale; upper: max of (y(t) - upper(t)) / scale;
    equality: the y(t) - lower(t), over scale, that is farthest from 0.
    """

    def __init__(self, bounds: tuple[SignalBound, ...]) -> None:
        self._bounds = bounds

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is said to be not finite
    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        columns = [column for bound in self._bounds for column in _sides(bound, simulated)]
        table = np.array(columns, np.float64).reshape(-1, len(simulated.outputs))
        return ComparisonResult(np.ascontiguousarray(table.T))


def _sides(bound: SignalBound, simulated: SimulatedOutputs) -> list[FloatArray]:
    """(points,) for each side of a bound."""
    rows = positions(bound.times, simulated.times)
    signal = simulated.of(bound.variable)[:, rows]
    if bound.equality:
        gaps = (signal - bound.lower) / bound.scale
        farthest = np.argmax(np.abs(gaps), axis=1)
        return [gaps[np.arange(len(gaps)), farthest]]
    found = []
    for limit, sign in ((bound.lower, -1.0), (bound.upper, 1.0)):
        held = np.isfinite(limit)
        if held.any():
            found.append(np.max(sign * (signal[:, held] - limit[held]), axis=1) / bound.scale)
    return found
