"""Bounds on the errors of a Jacobian by finite differences, column by column.

A direction that the data do not determine at all does not show as 0 in such a Jacobian, but as the
sum of the errors of its columns: from the noise of the simulation over the step, and from the
curvature times the step (forward) or its square (central); see
`methods.differences`.
"""

from __future__ import annotations

import numpy as np

from cluster_est.methods.differences import difference_steps, relative_noise
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray, Output

ERROR_SAFETY_FACTOR = 30.0
"""The noise of a solver and the curvature are known by their orders of magnitude only."""
ROUNDING_OF_DERIVATIVES = 1e-13
ABOUT_ZERO = 0.01
"""Part of the typical size below which an unknown is about 0."""


def relative_sizes(space: SearchSpace, x: FloatArray) -> FloatArray:
    """Return the size to which a change of each unknown is relative: itself, unless about 0."""
    own = np.where(np.abs(x) > ABOUT_ZERO * space.typical, np.abs(x), space.typical)
    return np.where(space.logarithmic, 1.0, own)


def column_errors(
    space: SearchSpace,
    x: FloatArray,
    sensitivity: FloatArray,
    outputs: float,
    steps: FloatArray | None,
) -> FloatArray:
    """Return (unknowns,): the error of each column over its norm, with a margin.

    Parameters
    ----------
    space, x
        The space and the point.
    sensitivity : (unknowns,)
        Norms of the columns, for a relative change of each unknown.
    outputs
        The norm of the simulated outputs, in units of the residuals.
    steps
        Of the differences; forward ones are assumed where they are not known. Their size
        shows whether they were forward or central.
    """
    noise = relative_noise(space.problem.model.solver)
    usual = difference_steps(space, x, "forward", 0.0)
    steps = np.abs(usual if steps is None else np.where(steps != 0.0, steps, usual))
    # the scheme follows from the size of the steps
    asked = float(np.median(steps / np.where(usual != 0.0, np.abs(usual), 1.0))) if len(x) else 1.0
    central = asked > noise ** (-1.0 / 12.0)  # the middle between both, on a logarithmic scale
    one_sided = (x + steps > space.upper) | (x - steps < space.lower)
    relative = steps / relative_sizes(space, x)
    curvature = np.where(one_sided | (not central), relative, relative**2)
    least = np.finfo(float).tiny
    return _errors(curvature, noise * outputs / np.maximum(relative, least), sensitivity)


def measured_errors(
    space: SearchSpace, sensitivity: FloatArray, outputs: float, measured_steps: FloatArray
) -> FloatArray:
    """Return them for directions measured with steps of these relative sizes; see `sharpen`."""
    noise = relative_noise(space.problem.model.solver)
    return _errors(measured_steps**4, noise * outputs / measured_steps, sensitivity)


def _errors(curvature: FloatArray, noise: FloatArray, sensitivity: FloatArray) -> FloatArray:
    """Return relative errors; a column that is not larger than its noise is nothing but error."""
    over = np.divide(noise, sensitivity, out=np.full(len(noise), np.inf), where=sensitivity > 0.0)
    return np.asarray(
        np.maximum(
            ERROR_SAFETY_FACTOR * (curvature + np.minimum(over, 1.0)), ROUNDING_OF_DERIVATIVES
        )
    )


def output_norm(space: SearchSpace, factor: FloatArray | None = None) -> float:
    """Return the norm of the measured outputs, weighted like the residuals; 0 if not known."""
    parts = [np.zeros(0)]
    for e in space.experiments:
        experiment = space.problem.experiments[e]
        if experiment.cost_function is not None or experiment.curve is not None:
            return 0.0
        parts += [_size(output) for output in experiment.outputs]
    values = np.concatenate(parts)
    if factor is None:
        return float(np.linalg.norm(values))
    return float(np.linalg.norm(values * factor)) if len(values) == len(factor) else 0.0


def _size(output: Output) -> FloatArray:
    """Return what a simulated output is about, in sigmas; of an ordinal one its spread."""
    return (np.ones(len(output.times)) if output.ordinal else output.values) / output.sigmas
