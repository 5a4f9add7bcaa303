"""The mass-spring-damper solved exactly, independently of the project: by matrix exponentials.

For a linear system whose input is linear between its samples, first-order-hold discretisation is no
approximation.
"""

import numpy as np
from scipy.linalg import expm


def position(
    times: np.ndarray, force: np.ndarray, m: float, k: float, c: float, x0: float, v0: float = 0.0
) -> np.ndarray:
    """Displacement at equally spaced times, with the force linear between them."""
    step = times[1] - times[0]
    system = np.array(
        [[0.0, 1.0, 0.0, 0.0], [-k / m, -c / m, 1.0 / m, 0.0], [0, 0, 0, 1.0], [0] * 4]
    )
    forward = expm(system * step)
    slopes = np.append(np.diff(force) / step, 0.0)
    state = np.array([x0, v0])
    result = np.empty(len(times))
    for i in range(len(times)):
        result[i] = state[0]
        state = forward[:2] @ np.array([*state, force[i], slopes[i]])
    return result
