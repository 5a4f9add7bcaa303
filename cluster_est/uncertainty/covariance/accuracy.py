"""Bounds on the errors of each column of a Jacobian from finite differences.

Along a direction that the data do not determine, such a Jacobian is not 0 but contains the errors
of its columns. They come from the noise of the simulation over the step, and from the curvature
times the step (forward) or its square (central); see `methods.differences`.
"""

from __future__ import annotations

import numpy as np

from cluster_est.methods.differences import difference_steps, relative_noise
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray, Output

ERROR_SAFETY_FACTOR = 30.0
"""Safety factor, because only the magnitudes of solver noise and curvature are known."""
ROUNDING_OF_DERIVATIVES = 1e-13
ABOUT_ZERO = 0.01
"""Share of the typical size below which an unknown is about 0."""


def relative_sizes(space: SearchSpace, x: FloatArray) -> FloatArray:
    """Return the reference size for relative changes of each unknown: its value, unless about 0."""
    own = np.where(np.abs(x) > ABOUT_ZERO * space.typical, np.abs(x), space.typical)
    return np.where(space.logarithmic, 1.0, own)


def column_errors(
    space: SearchSpace,
    x: FloatArray,
    sensitivity: FloatArray,
    outputs: float,
    steps: FloatArray | None,
) -> FloatArray:
    """Return the error of each column over its norm, with a safety margin: (unknowns,).

    Parameters
    ----------
    space, x
        The search space, and the point.
    sensitivity : (unknowns,)
        Norms of the columns, for a relative change of each unknown.
    outputs
        The norm of the simulated outputs, in units of the residuals.
    steps
        Steps of the differences; None for the usual forward steps. The size of the steps shows
        whether the differences were forward or central.
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
    """Return the errors of directions measured with these relative steps; see `sharpen`."""
    noise = relative_noise(space.problem.model.solver)
    return _errors(measured_steps**4, noise * outputs / measured_steps, sensitivity)


def _errors(curvature: FloatArray, noise: FloatArray, sensitivity: FloatArray) -> FloatArray:
    """Return relative errors; the noise of a column is at most the column itself."""
    over = np.divide(noise, sensitivity, out=np.full(len(noise), np.inf), where=sensitivity > 0.0)
    return np.asarray(
        np.maximum(
            ERROR_SAFETY_FACTOR * (curvature + np.minimum(over, 1.0)), ROUNDING_OF_DERIVATIVES
        )
    )


def output_norm(space: SearchSpace, factor: FloatArray | None = None) -> float:
    """Return the norm of the measured outputs, weighted like the residuals; 0 if unknown."""
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
    """Return the approximate size of a simulated output in sigmas; 1 for an ordinal output."""
    return (np.ones(len(output.times)) if output.ordinal else output.values) / output.sigmas
