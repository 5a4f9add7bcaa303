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


def late_states(added: Callable[[np.ndarray, np.ndarray], list[float]], delay: float) -> np.ndarray:
    """The position, with a term in the states and in those of some seconds ago added to the rates.

    By the method of steps, with a classic Runge-Kutta method whose stages at `delay` seconds ago
    are known: on a fine grid that has all kinks, with the middle of each step from Hermite's cubic.
    """
    h = 0.0005
    back = round(delay / h)
    times = np.arange(round(TIMES[-1] / h) + 1) * h
    force = np.interp(np.arange(2 * len(times) - 1) * (h / 2.0), TIMES, FORCE)
    states, rates = np.tile(START, (len(times), 1)).astype(float), np.zeros((len(times), 2))

    def rate(n: int, x: np.ndarray, late: np.ndarray) -> np.ndarray:
        return np.array(plain(0.0, x, force[n])) + added(x, late)

    for n in range(len(times) - 1):
        a, b = max(n - back, 0), max(n + 1 - back, 0)
        slopes = rates[a] - rates[b] if b > a else np.zeros(2)
        middle = 0.5 * (states[a] + states[b]) + h / 8.0 * slopes
        x, late = states[n], states[a]
        k1 = rates[n] = rate(2 * n, x, late)
        k2 = rate(2 * n + 1, x + 0.5 * h * k1, middle)
        k3 = rate(2 * n + 1, x + 0.5 * h * k2, middle)
        k4 = rate(2 * n + 2, x + h * k3, states[b])
        states[n + 1] = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    at = np.rint(TIMES / h).astype(int)
    return states[at, 0]
