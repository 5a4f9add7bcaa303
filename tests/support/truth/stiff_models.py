"""The stiff test models' equations, written down again, solved by SciPy's Radau."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from cluster_est import Experiment, Input, Output

START = np.array([1.0, 0.0, 0.0])
K1, K2, K3, DRAIN = 0.04, 3e7, 1e4, 0.1
TIGHT = {"method": "Radau", "rtol": 1e-11, "atol": 1e-15}


def oscillation(times: np.ndarray) -> Experiment:
    """The oscillator left to itself."""
    measured = Output("y", times, np.zeros(len(times)))
    return Experiment("free", float(times[0]), float(times[-1]), (), (measured,))


def reaction(experiment: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """All times of the experiment, and the first two substances there; (times, 2)."""
    (feed,), start = experiment.inputs, experiment.start
    times = np.unique(np.concatenate([feed.times, *(o.times for o in experiment.outputs)]))
    times = times[(times >= start) & (times <= experiment.stop)]
    held = feed.interpolation == "hold"
    states = [START]
    for first, last in pairwise(times):
        latest = feed.values[np.searchsorted(feed.times, first, side="right") - 1]

        def slope(t, x, latest=latest):
            u = latest if held else np.interp(t, feed.times, feed.values)
            first, second, third = K1 * x[0], K2 * x[1] ** 2, K3 * x[1] * x[2]
            return [
                u - DRAIN * x[0] - first + third,
                first - second - third - DRAIN * x[1],
                second - DRAIN * x[2],
            ]

        states.append(solve_ivp(slope, (first, last), states[-1], **TIGHT).y[:, -1])
    return times, np.array(states)[:, :2]


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
