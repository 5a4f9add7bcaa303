"""Kinematic equations: states that are the integrals of others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.thresholds import CandidateThresholds

CONSTANT = 1e-4
"""Share of its factor by which a kinematic equation may change along a trajectory."""


def integrated_states(
    trajectories: Sequence[LinearisedTrajectory],
    tolerance: float = CandidateThresholds.kinematic,
) -> dict[str, tuple[str, float]]:
    """Find the states x with dx/dt = c v, where v is another state and c a constant.

    Parameters
    ----------
    trajectories
        The first one with a linear system is looked at: the equations are those of all.
    tolerance
        Largest share of the derivative that the equation may leave.

    Returns
    -------
    dict
        v and c by x: its speed and 1 for an angle, that of a wheel and its radius for a way.
    """
    found: dict[str, tuple[str, float]] = {}
    linear = next((each.linear for each in trajectories if each.linear is not None), None)
    if linear is None:
        return found
    names = linear.state_names
    for i, name in enumerate(names):
        own = linear.A.row(i)
        j = int(np.argmax(np.abs(own[0])))
        factor = float(own[0, j])
        size = np.abs(linear.derivatives[:, i]).max()
        gap = np.abs(linear.derivatives[:, i] - factor * linear.states[:, j]).max()
        if i == j or gap > tolerance * size:
            continue
        row = np.abs(own - factor * np.eye(len(names))[j]).max()
        driven = np.abs(linear.B[:, i]).max(initial=0.0)
        if max(row, driven) < CONSTANT * abs(factor):
            found[name] = names[j], factor
    return found
