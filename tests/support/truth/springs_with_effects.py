"""The mass-spring-damper with an effect in it: SciPy on equations written down again."""

from collections.abc import Callable

import numpy as np
from scipy.integrate import ode

M, K, C = 1.2, 30.0, 0.6
TIMES = np.arange(200) * 0.02
FORCE = 3.0 * np.random.default_rng(0).normal(size=len(TIMES))
START = (0.1, 0.0)
SITES = {
    "derivative": "der(v)",
    "pair": "pair x,v",
    "input": "input F",
    "output": "output y",
    "parameter": "parameter c",
}
"""A site of each kind."""

Slope = Callable[[float, np.ndarray, float], list[float]]


def plain(t: float, x: np.ndarray, force: float) -> list[float]:
    """[v, dv/dt] of x = [x, v, ...]."""
    return [x[1], (force - K * x[0] - C * x[1]) / M]


def pushed(term: Callable[[float, np.ndarray, float], float]) -> Slope:
    """The model with a term added to der(v)."""

    def slope(t: float, x: np.ndarray, force: float) -> list[float]:
        v, dv = plain(t, x, force)
        return [v, dv + term(t, x, force)]

    return slope


def solve(
    slope: Slope, start: tuple[float, ...] = START, times: np.ndarray = TIMES, force=FORCE
) -> np.ndarray:
    """States at the times, with the force linear between them; (times, states)."""
    states = [np.array(start)]
    for i in range(len(times) - 1):
        rise = (force[i + 1] - force[i]) / (times[i + 1] - times[i])

        def inside(t, x, i=i, rise=rise):
            return slope(t, x, force[i] + rise * (t - times[i]))

        solver = ode(inside).set_integrator("dop853", rtol=1e-10, atol=1e-12, nsteps=100_000)
        states.append(solver.set_initial_value(states[-1], times[i]).integrate(times[i + 1]))
    return np.array(states)
