"""Jacobian of residuals and constraints by the parameters, from sensitivities of the outputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from workers.messages import FloatArray
from workers.residuals.base import Comparison, SimulatedOutputs
from workers.residuals.measured_times import MeasuredTimes

RELATIVE_STEP = 1e-6
"""Of the outputs, for a comparison that is not linear in them: it is no simulation, so rounding is
all its noise."""


def comparison_jacobian(
    comparison: Comparison, simulated: SimulatedOutputs, sensitivities: FloatArray
) -> FloatArray:
    """Return the (k, parameters) derivatives of the values of a comparison.

    Parameters
    ----------
    simulated
        One simulation.
    sensitivities : (parameters, n, names)
        Derivatives of its outputs.
    """
    if isinstance(comparison, MeasuredTimes):
        return np.ascontiguousarray(comparison.jacobian(sensitivities).T)
    count = len(sensitivities)
    steps = _steps(simulated, sensitivities)
    values = np.repeat(simulated.values[:, :count], count, axis=0)
    found = []
    for sign in (1.0, -1.0):
        outputs = simulated.outputs + sign * steps[:, None, None] * sensitivities
        perturbed = replace(simulated, outputs=outputs, values=values + sign * np.diag(steps))
        found.append(comparison.compare(perturbed).values)
    return np.ascontiguousarray(((found[0] - found[1]) / (2.0 * steps[:, None])).T)


def _steps(simulated: SimulatedOutputs, sensitivities: FloatArray) -> FloatArray:
    """Return a step for each parameter that changes neither it nor any output by much."""
    largest = np.abs(sensitivities).max(axis=(1, 2), initial=0.0)
    size = np.abs(simulated.outputs).max(initial=0.0) or 1.0
    own = np.abs(simulated.values[0, : len(sensitivities)])
    own[own == 0.0] = 1.0
    with np.errstate(divide="ignore"):
        steps: FloatArray = RELATIVE_STEP * np.fmin(own, size / largest)
    return steps
