"""Places before forms: sites with an argument, ranked by what a free curve there would explain.

Where there are too many candidates to compare each with the residual, those at the leading places
are. The curve is piecewise linear in the argument, with one set of coefficients for all
experiments. With D its directions outside the declared parameters, and r the residual, it explains
b'(D'D)^-1 b, b = D'r. The adjoint gives b at all places from one integration, and D'D from some
random weightings z more: E[D'z z'D] = D'D (M. F. Hutchinson, Commun. Stat. Simul. Comput. 18 (1989)
1059-1076, doi:10.1080/03610918908812806).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cluster_est.closed_loop.candidates.arguments import CandidatePlace
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from cluster_est.closed_loop.screening.adjoint import AdjointSignals, adjoint_signals
from cluster_est.closed_loop.statistics.projection import ProjectedResidual
from cluster_est.closed_loop.thresholds import PlaceThresholds
from workers.effects.site import EffectSite
from workers.messages import FloatArray

DEPENDENT = 1e-6
"""Smallest eigenvalue of D'D, over the largest, of a direction that counts: knots may coincide."""


@dataclass(frozen=True)
class RankedPlace:
    """A place, and the statistic of a free curve there, less the price of its coefficients."""

    place: CandidatePlace
    statistic: float


def rank_places(
    places: Sequence[CandidatePlace],
    trajectories: Sequence[LinearisedTrajectory],
    residual: ProjectedResidual,
    generator: np.random.Generator,
    thresholds: PlaceThresholds,
) -> list[RankedPlace]:
    """Order places by what a free curve there would explain of the residual, the most first.

    Parameters
    ----------
    places
        To be ordered.
    trajectories
        Of the training experiments, with linearisations.
    residual
        Of the fit that they are added to.
    generator
        Of the random weightings.
    thresholds
        Their number, and that of a curve's coefficients.
    """
    if not places:
        return []
    draws = generator.standard_normal((len(residual.residuals), thresholds.weightings))
    weights = residual.projection.remove(np.column_stack([residual.residuals, draws]))
    variance = float(np.sum(weights[:, 0] ** 2)) / max(residual.projection.degrees, 1)
    sites = list(dict.fromkeys(place.site for place in places))
    names = list(dict.fromkeys(place.argument for place in places))
    knots = {name: _knots(trajectories, name, thresholds.hats) for name in names}
    width = 1 + thresholds.weightings
    ports = dict(zip(sites, pairwise(np.cumsum([0, *map(_width, sites)]).tolist()), strict=True))
    products = np.zeros((len(names) * thresholds.hats, width * sum(map(_width, sites))))
    ends = np.cumsum([0, *(len(trajectory.rows) for trajectory in trajectories)]).tolist()
    for trajectory, (start, stop) in zip(trajectories, pairwise(ends), strict=True):
        signals = adjoint_signals(trajectory, weights[start:stop])
        hats = np.hstack([_hats(trajectory, name, knots[name], thresholds.hats) for name in names])
        acting = np.hstack([_acting(trajectory, signals, site) for site in sites])
        products += hats.T @ acting
    shape = (len(names), thresholds.hats, -1, width)
    blocks = dict(zip(names, products.reshape(shape).transpose(0, 2, 1, 3), strict=True))
    ranks = []
    for place in places:
        first, last = ports[place.site]
        block = blocks[place.argument][first:last].reshape(-1, width)
        ranks.append(_rank(block, variance, thresholds.price))
    order = np.argsort(-np.array(ranks), kind="stable").tolist()
    return [RankedPlace(places[i], ranks[i]) for i in order]


def _rank(block: FloatArray, variance: float, price: float) -> float:
    """The score statistic of a curve, less the price of its coefficients."""
    b, sketch = block[:, 0], block[:, 1:]
    count = sketch.shape[1]
    sizes = np.sqrt(np.mean(sketch**2, axis=1))
    used = sizes > 0.0
    if not used.any():
        return -np.inf
    b, sketch = b[used] / sizes[used], sketch[used] / sizes[used, None]
    values, vectors = np.linalg.eigh(sketch @ sketch.T / count)
    kept = values > DEPENDENT * values[-1]
    shares = (vectors[:, kept].T @ b) ** 2 / values[kept]
    d = int(kept.sum())
    unbiased = max(count - d - 1, 1) / count  # of an inverse, T. W. Anderson (2003), lemma 7.7.1
    return float(unbiased * shares.sum()) / max(variance, 1e-300) - price * (d - 1)


def _width(site: EffectSite) -> int:
    return len(site.targets) if site.kind == "pair" else 1


def _acting(
    trajectory: LinearisedTrajectory, signals: AdjointSignals, site: EffectSite
) -> FloatArray:
    """(n, width m): what a function at a site weighs with; at an input it multiplies the signal."""
    if site.kind == "pair":
        return np.hstack([signals.at(site, state) for state in site.targets])
    acting = signals.at(site)
    return acting * trajectory.signal(site.target)[:, None] if site.kind == "input" else acting


def _knots(trajectories: Sequence[LinearisedTrajectory], name: str, hats: int) -> FloatArray:
    """Knots over an argument's range, half way to its quantiles: where it is, and at its ends."""
    v = pooled(trajectories, name)
    shares = np.linspace(0.0, 1.0, hats)
    even = v.min() + shares * (v.max() - v.min())
    return np.unique(0.5 * (even + np.quantile(v, shares)))


def _hats(trajectory: LinearisedTrajectory, name: str, knots: FloatArray, hats: int) -> FloatArray:
    """(n, hats): piecewise linear functions that are 1 at one knot and 0 at all others."""
    found = np.zeros((len(trajectory.times), hats))
    if not trajectory.has(name):
        return found
    v = np.clip(trajectory.signal(name), knots[0], knots[-1])
    for k, heights in enumerate(np.eye(len(knots))):
        found[:, k] = np.interp(v, knots, heights)
    return found
