"""How residuals and constraints change with parameters, from how the outputs do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from workers.messages import FloatArray
from workers.residuals.base import Comparison, SimulatedBatch
from workers.residuals.measured_times import MeasuredTimes

RELATIVE_STEP = 1e-6
"""Of the outputs, for a comparison that is not linear in them: it is no simulation, so rounding is
all its noise."""


def comparison_slopes(
    comparison: Comparison, simulated: SimulatedBatch, slopes: FloatArray
) -> FloatArray:
    """(k, parameters): the derivatives of what a comparison gives.

    Parameters
    ----------
    simulated
        One simulation.
    slopes : (parameters, n, names)
        The derivatives of its record.
    """
    if isinstance(comparison, MeasuredTimes):
        return np.ascontiguousarray(comparison.slopes(slopes).T)
    count = len(slopes)
    steps = _steps(simulated, slopes)
    values = np.repeat(simulated.values[:, :count], count, axis=0)
    found = []
    for sign in (1.0, -1.0):
        record = simulated.record + sign * steps[:, None, None] * slopes
        moved = replace(simulated, record=record, values=values + sign * np.diag(steps))
        found.append(comparison.compare(moved).values)
    return np.ascontiguousarray(((found[0] - found[1]) / (2.0 * steps[:, None])).T)


def _steps(simulated: SimulatedBatch, slopes: FloatArray) -> FloatArray:
    """A step for each parameter that changes neither it nor any output by much."""
    largest = np.abs(slopes).max(axis=(1, 2), initial=0.0)
    size = np.abs(simulated.record).max(initial=0.0) or 1.0
    own = np.abs(simulated.values[0, : len(slopes)])
    own[own == 0.0] = 1.0
    with np.errstate(divide="ignore"):
        steps: FloatArray = RELATIVE_STEP * np.fmin(own, size / largest)
    return steps
