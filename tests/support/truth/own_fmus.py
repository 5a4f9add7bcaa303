"""What the test FMUs of `tests/fmus` must show: closed forms, or SciPy on the same equations.

Nothing of the project is used but its data classes. At an event the values are those after it.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from cluster_est import Experiment, Input, Output

Array = NDArray[np.float64]
DRAIN = 0.1


def bouncing_ball(
    times: Array, h: float = 1.0, g: float = 9.81, e: float = 0.7, v_min: float = 0.1
) -> tuple[Array, Array, Array]:
    """Height, velocity and number of bounces of a ball dropped at rest at time 0."""
    height, velocity, bounces = np.zeros((3, len(times)))
    begin, h0, v0, count = 0.0, h, 0.0, 0
    while True:
        fall = (v0 + np.sqrt(v0 * v0 + 2.0 * g * h0)) / g
        inside = (times >= begin) & (times < begin + fall)
        t = times[inside] - begin
        height[inside] = h0 + v0 * t - 0.5 * g * t * t
        velocity[inside] = v0 - g * t
        bounces[inside] = count
        begin, h0, v0, count = begin + fall, 0.0, e * (g * fall - v0), count + 1
        if v0 < v_min:
            bounces[times >= begin] = count
            return height, velocity, bounces


def stair(times: Array, height: float = 1.0) -> Array:
    """The counter times the height of a stair: 1 at time 0, one more each second."""
    return np.asarray(height * (1.0 + np.floor(times)))


def dahlquist(times: Array, k: float = 1.0, x0: float = 1.0) -> Array:
    """x of dx/dt = -k x."""
    return x0 * np.exp(-k * times)


def step_events(times: Array, rate: float = 1.0) -> Array:
    """A sawtooth from 0 to 1; in the FMU it falls at the end of the integrator's step."""
    return np.asarray(np.mod(rate * times, 1.0))


def nominals(times: Array, rate: float = 1.0) -> tuple[Array, Array]:
    """x of dx/dt = rate x, and its nominal value: the power of ten below it."""
    x = np.exp(rate * times)
    return x, 10.0 ** np.floor(np.log10(x))


def iterates(times: Array, rounds: int = 5, rate: float = 1.0) -> Array:
    """A ramp with a jump of `rounds` each second."""
    return rate * times + rounds * np.floor(times)


def thermostat(
    times: Array,
    heat: float = 600.0,
    ambient: float = 5.0,
    start: float = 17.0,
    capacity: float = 1e4,
    conductance: float = 20.0,
    low: float = 19.0,
    high: float = 21.0,
) -> tuple[Array, Array, Array]:
    """Temperature, whether it heats, and the times of the switches, for constant inputs."""
    temperature, on = np.empty((2, len(times)))
    switches: list[float] = []
    constant = capacity / conductance
    begin, value, heating = 0.0, start, start <= low
    while True:
        rest = ambient + heating * heat / conductance
        goal = high if heating else low
        end = begin + constant * np.log((rest - value) / (rest - goal))
        inside = (times >= begin) & (times < end)
        temperature[inside] = rest + (value - rest) * np.exp((begin - times[inside]) / constant)
        on[inside] = heating
        if end > times[-1]:
            return temperature, on, np.array(switches)
        switches.append(end)
        begin, value, heating = end, goal, not heating


def van_der_pol(times: Array, mu: float = 1.0) -> Array:
    """(times, states) of Van der Pol's equation from (2, 0), which is stiff for a large mu."""

    def rates(_: float, x: Array) -> list[float]:
        return [x[1], mu * (1.0 - x[0] * x[0]) * x[1] - x[0]]

    return solved(rates, [2.0, 0.0], times, stiff=mu > 10.0)


def reacting(_: float, x: Array) -> Array:
    """dx/dt of Robertson's reactions."""
    first, second, third = 0.04 * x[0], 3e7 * x[1] ** 2, 1e4 * x[1] * x[2]
    return np.array([third - first, first - third - second, second])


def robertson(times: Array) -> Array:
    """(times, states) of Robertson's reactions from (1, 0, 0)."""
    return solved(reacting, [1.0, 0.0, 0.0], times, stiff=True)


def solved(rates, start, times: Array, stiff: bool) -> Array:
    """(times, states), each solved to a time and not interpolated."""
    method = "Radau" if stiff else "DOP853"
    found, x, now = np.empty((len(times), len(start))), np.array(start), 0.0
    for place, time in enumerate(times):
        if time > now:
            result = solve_ivp(rates, (now, time), x, method, rtol=1e-12, atol=1e-14)
            x, now = result.y[:, -1], time
        found[place] = x
    return found


def oscillation(times: Array) -> Experiment:
    """The oscillator left to itself."""
    measured = Output("y", times, np.zeros(len(times)))
    return Experiment("free", float(times[0]), float(times[-1]), (), (measured,))


def fed(interpolation: str, seed: int = 0) -> Experiment:
    """The reaction, fed at random, the feed and both outputs sampled at times of their own."""
    generator = np.random.default_rng(seed)
    knots = np.concatenate([[0.0], np.sort(generator.uniform(0.5, 39.0, 12)), [40.0]])
    feed = Input("feed", knots, generator.uniform(0.0, 0.3, len(knots)), interpolation)  # type: ignore[arg-type]
    outputs = tuple(
        Output(name, np.sort(generator.uniform(0.0, 40.0, 17)), np.zeros(17))
        for name in ("y_a", "y_b")
    )
    return Experiment("fed", 0.0, 40.0, (feed,), outputs)


def reaction(experiment: Experiment) -> tuple[Array, Array]:
    """All times of such an experiment, and the first two substances there; (times, 2)."""
    (feed,), start = experiment.inputs, experiment.start
    times = np.unique(np.concatenate([feed.times, *(o.times for o in experiment.outputs)]))
    times = times[(times >= start) & (times <= experiment.stop)]
    states = [np.array([1.0, 0.0, 0.0])]
    for first, last in pairwise(times):
        latest = feed.values[np.searchsorted(feed.times, first, side="right") - 1]

        def rates(t: float, x: Array, latest: float = latest) -> Array:
            u = latest if feed.interpolation == "hold" else np.interp(t, feed.times, feed.values)
            return reacting(t, x) - DRAIN * x + np.array([u, 0.0, 0.0])

        found = solve_ivp(rates, (first, last), states[-1], "Radau", rtol=1e-11, atol=1e-15)
        states.append(found.y[:, -1])
    return times, np.array(states)[:, :2]
