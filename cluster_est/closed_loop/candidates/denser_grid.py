"""Denser grids of shape parameters, for a closer look at a few candidates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from workers.effects.forms import GridScale
from workers.messages import FloatArray

BETWEEN = 4
"""Steps for each one of the candidate's own grid."""
PLACES = np.linspace(0.04, 0.96, 24)
"""Quantiles of its argument at which an effect may begin."""
MANY = 12
"""Points of a grid that is dense as it is: of waves."""


def denser_grid(
    candidate: EffectCandidate, trajectories: Sequence[LinearisedTrajectory]
) -> list[tuple[float, ...]]:
    """Return a grid with more points in the one coefficient that the candidate's own grid varies.

    Where an effect begins must be nearly right, or it looks like less than one that begins nowhere.
    A grid in several coefficients stays as it is.

    Parameters
    ----------
    candidate
        Of the library.
    trajectories
        Of a model near the data, over which its argument goes.
    """
    rows = np.array(candidate.grid)
    moving = np.flatnonzero(np.ptp(rows, axis=0) > 0.0)
    if len(moving) != 1 or len(rows) > MANY:
        return list(candidate.grid)
    values = _values(candidate, int(moving[0]), rows[:, moving[0]], trajectories)
    dense = np.repeat(rows[:1], len(values), axis=0)
    dense[:, moving[0]] = values
    return [tuple(row) for row in dense.tolist()]


def _values(
    candidate: EffectCandidate,
    position: int,
    own: FloatArray,
    trajectories: Sequence[LinearisedTrajectory],
) -> FloatArray:
    if candidate.form.coefficients[position].scale is GridScale.QUANTILE_V:
        return np.asarray(np.quantile(pooled(trajectories, candidate.effect.variables[0]), PLACES))
    known = np.sort(own)
    at = np.linspace(0.0, len(known) - 1.0, (len(known) - 1) * BETWEEN + 1)
    if (known > 0.0).all():
        return np.exp(np.interp(at, np.arange(len(known)), np.log(known)))
    return np.interp(at, np.arange(len(known)), known)
