"""Residuals and constraints of a curve that was measured without times."""

from __future__ import annotations

import numpy as np

from workers.messages import Curve, FloatArray
from workers.residuals.base import Comparison, ComparisonResult, SimulatedOutputs, positions
from workers.residuals.nearest_segment import segment_distances, tolerance_constraints


class CurveDistances(Comparison):
    """For each segment between two measured points its distance to the nearest simulated one."""

    def __init__(self, curve: Curve) -> None:
        self._curve = curve

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        points = _points(self._curve, simulated)
        found = [segment_distances(each, self._curve.points) for each in points]
        return ComparisonResult(np.array(found, np.float64).reshape(len(points), -1))


class CurveTolerances(Comparison):
    """For each tolerance how far the farthest simulated point lies from the measured curve."""

    def __init__(self, curve: Curve) -> None:
        self._curve = curve

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        tolerances = np.array(self._curve.tolerances)
        points = _points(self._curve, simulated)
        found = [tolerance_constraints(each, self._curve.points, tolerances) for each in points]
        return ComparisonResult(np.array(found, np.float64).reshape(len(points), -1))


def _points(curve: Curve, simulated: SimulatedOutputs) -> FloatArray:
    """(points, m, d): the simulated curves at the times at which they are sampled."""
    rows = positions(curve.times, simulated.times)
    columns = [simulated.names.index(name) for name in curve.variables]
    return np.ascontiguousarray(simulated.outputs[:, rows][:, :, columns])
