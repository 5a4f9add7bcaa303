"""The step that minimises the linear model of the residuals, and how far one may go at once."""

from __future__ import annotations

import numpy as np

from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray


def gauss_newton_step(jacobian: FloatArray, residuals: FloatArray) -> FloatArray:
    """Return the step that minimises the linear model of the residuals, whatever the units.

    Parameters
    ----------
    jacobian : (N, unknowns)
    residuals : (N,)

    Returns
    -------
    (unknowns,)
        Zero for an unknown without effect.
    """
    sizes = np.linalg.norm(jacobian, axis=0)
    sizes[~(sizes > 0.0)] = 1.0
    step: FloatArray = np.linalg.lstsq(jacobian / sizes, -residuals, rcond=1e-6)[0] / sizes
    return step


def longest_step(space: SearchSpace, x: FloatArray, largest: float) -> FloatArray:
    """Return how far each unknown may be moved from a point at once, in search coordinates.

    Parameters
    ----------
    space, x
        The unknowns, and where they stand: (unknowns,).
    largest
        Of a parameter: in logarithms, or as a share of its value.
    """
    log = space.logarithmic
    return largest * np.where(log, 1.0, np.maximum(np.abs(x), space.typical))
