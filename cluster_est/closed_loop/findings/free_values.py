"""What the residuals of a fitted model ask for at the site of an effect, without any form.

A partial residual, as of a regression (W. A. Larsen, S. J. McCleary, Technometrics 14 (1972)
781-790, doi:10.1080/00401706.1972.10488966): a free function of the effect's argument is fitted to
what the model leaves, with all its parameters held, through the system linear around the fit. It is
what the effect would have to add beside its own form.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import (
    Forcing,
    LinearisedTrajectory,
    linear_system,
)
from cluster_est.closed_loop.screening.directions import coupling
from workers.effects.site import EffectSite
from workers.messages import FloatArray

PLACES = 12
"""Of a free function: more are not told apart by the eye."""

DETERMINED = 1e-8
"""Share of the largest squared length that the direction of a place needs."""


def free_values(
    site: EffectSite,
    trajectories: Sequence[LinearisedTrajectory],
    arguments: Sequence[FloatArray | None],
    residuals: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Fit a piecewise linear function of an argument to the residuals of a fit.

    Parameters
    ----------
    site
        Where it acts; at pairs of derivatives nothing is fitted.
    trajectories
        Of the training experiments at the fit, linearised.
    arguments : (n,) for each trajectory
        None where an experiment does not have it.
    residuals : (N,)
        Of all training experiments, over sigma.

    Returns
    -------
    Places of the argument, values and their standard errors as of white noise, each (places,); None
    where the site or the interface does not allow it.
    """
    if site.kind == "pair" or (site.kind != "output" and trajectories[0].linear is None):
        return None
    known = np.concatenate([each for each in arguments if each is not None] or [np.zeros(0)])
    if not len(known) or not np.ptp(known) > 0.0:
        return None
    shares = np.linspace(0.0, 1.0, PLACES)
    even = known.min() + shares * np.ptp(known)
    between = 0.5 * (even + np.quantile(known, shares))
    at = np.unique(np.clip(between, known.min(), known.max()))
    parts = [
        _directions(site, each, _hats(at, values, len(each.times)))
        for each, values in zip(trajectories, arguments, strict=True)
    ]
    direction = np.concatenate(parts)
    sizes = np.einsum("ij,ij->j", direction, direction)
    kept = sizes > DETERMINED * sizes.max()
    if not kept.any() or len(residuals) <= kept.sum():
        return None
    q, r = np.linalg.qr(direction[:, kept])
    if not np.all(np.abs(np.diag(r)) > 1e-9 * np.abs(r).max()):
        return None
    found = -np.linalg.solve(r, q.T @ residuals)
    left = residuals + direction[:, kept] @ found
    variance = float(left @ left) / (len(residuals) - int(kept.sum()))
    inverse = np.linalg.inv(r)
    return at[kept], found, np.sqrt(variance * np.einsum("ij,ij->i", inverse, inverse))


def _hats(at: FloatArray, values: FloatArray | None, size: int) -> FloatArray:
    """(n, places): a piecewise linear function with each of its values at 1, all others at 0."""
    if values is None:
        return np.zeros((size, len(at)))
    inside = np.clip(values, at[0], at[-1])
    return np.column_stack([np.interp(inside, at, height) for height in np.eye(len(at))])


def _directions(
    site: EffectSite, trajectory: LinearisedTrajectory, added: FloatArray
) -> FloatArray:
    """(k, places): how the residuals of an experiment change with what is added at a site."""
    count = added.shape[1]
    change = np.zeros((*trajectory.outputs.shape, count))
    if site.kind == "output":
        if site.target in trajectory.names:
            change[:, trajectory.names.index(site.target)] += added
        return trajectory.residual_change(change)
    linear = trajectory.linear
    if linear is None:
        raise ValueError(f"{site} has no direction without a linearisation")
    into: int | FloatArray
    if site.kind == "derivative":
        into = linear.state_names.index(site.target)
    else:
        into, through = coupling(linear, site)
        change += through[:, :, None] * added[:, None, :]
    forcing = Forcing(added, [into], np.zeros(count, int))
    return trajectory.residual_change(change + linear_system(linear).respond(forcing))
