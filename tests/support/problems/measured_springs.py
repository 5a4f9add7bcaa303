"""Springs with an effect that the FMU lacks, driven by random ramps and measured in noise."""

from collections.abc import Sequence

import numpy as np
from support.problems.springs import FMU
from support.truth.springs_with_effects import TIMES, C, K, Slope, solve

import cluster_est as ce
from workers.messages import Role

TURNS = 14
"""Points between which the force is linear."""


def measured_springs(
    slope: Slope,
    mass: ce.Parameter,
    *,
    swing: float,
    noise: float,
    random: np.random.Generator,
    roles: Sequence[Role],
) -> ce.Problem:
    """An experiment for each role; stiffness and damping start a tenth beside the truth."""
    runs, times = [], np.asarray(TIMES, np.float64)
    for number, role in enumerate(roles):
        turns = np.linspace(times[0], times[-1], TURNS)
        force = np.interp(times, turns, random.uniform(-swing, swing, len(turns)))
        truth = solve(slope, (0.1, 0.0), force=force)[:, 0]
        measured = truth + noise * random.normal(size=len(times))
        given, seen = ce.Input("F", times, force), ce.Output("y", times, measured, sigma=noise)
        name, last, start = f"run{number}", float(times[-1]), (("x", 0.1),)
        runs.append(ce.Experiment(name, 0.0, last, (given,), (seen,), start, role=role))
    stiffness = ce.Parameter("k", 0.9 * K, (1.0, 100.0))
    damping = ce.Parameter("c", 1.1 * C, (0.0, 10.0))
    model = ce.read_model(FMU)
    return ce.Problem(model, (mass, stiffness, damping), tuple(runs))
