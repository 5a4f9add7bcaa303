"""Ranking of places, each a site with an argument, by what a free curve there would explain.

With too many candidates to compare each with the residual, only those at the leading places are
compared. The curve is piecewise linear in the argument. With it come filters of the argument, some
lags and an oscillation, for effects with memory: a hidden store is hardly a function of its own
argument, and would be sought at another place whose argument it happens to follow. All experiments
share one set of coefficients. With D their directions outside the declared parameters, and r the
residual, a curve explains b'(D'D)^-1 b, b = D'r. One integration of the adjoint gives b at all
places: for a weighting w of the residuals, w'(D f) = (D'w)'f, and integrating backwards gives D'w
at every site at once. Random weightings z give D'D: E[D'z z'D] = D'D (M. F. Hutchinson,
Commun. Stat. Simul. Comput. 18 (1989) 1059-1076, doi:10.1080/03610918908812806).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Self

import numpy as np

from cluster_est.closed_loop.candidates.arguments import TIME, CandidatePlace, by_site
from cluster_est.closed_loop.candidates.array_forms import FormArguments, shape_of
from cluster_est.closed_loop.candidates.trajectory import (
    LinearisedTrajectory,
    hats,
    knots_over,
    linear_system,
    pooled,
)
from cluster_est.closed_loop.screening.directions import coupling
from cluster_est.statistics.projection import ProjectedResidual
from workers.effects.forms import FORMS, EffectForm
from workers.effects.site import EffectSite
from workers.messages import FloatArray, Linearisation


@dataclass(frozen=True)
class PlaceThresholds:
    """Thresholds of the ranking of places, for models with too many candidates to try each.

    Attributes
    ----------
    most_candidates
        Number of candidates above which only those at leading places are tried. Memory: see
        `most_rows`.
    leading
        Number of leading places that are tried. Benchmark.
    """

    most_candidates: int = 1500
    leading: int = 40


LEADING_PLACES = PlaceThresholds()

HATS = 9
"""Number of coefficients of the curve that stands for every form without memory."""
LAGS = 4
"""Number of time constants of the lags, at equal ratios; a mixture of two covers those between."""
SHORTEST_LAG, LONGEST_LAG = 3.0, 1.0 / 3.0
"""Shortest time constant, in steps, and longest, as a share of the longest record. Signal: a faster
lag is a gain of the argument, and a slower lag is its integral."""
RINGING = 0.1
"""Damping ratio of the oscillation, whose frequency is the first peak of the residual's spectrum.
Signal: with much less damping it rings for a whole record, with much more it is a lag."""
WEIGHTINGS = 160
"""Number of random weightings that estimate the size of a direction. The relative error of its
square is sqrt(2 / number). Benchmark: with 96, one in ten of the stores hidden in a
rod of twelve nodes is not among the leading places; with 160, none is missed."""
COLUMN_PENALTY = 8.0
"""Increase of the statistic that each additional column of a candidate, or coefficient of a curve,
must bring. Benchmark. Theory: for a column without meaning, its mean is 1 (chi-squared)."""


DEPENDENT = 1e-6
"""Smallest eigenvalue of D'D that counts, relative to the largest; knots may coincide."""


def rank_places(
    places: Sequence[CandidatePlace],
    trajectories: Sequence[LinearisedTrajectory],
    residual: ProjectedResidual,
    frequencies: Sequence[float],
    generator: np.random.Generator,
) -> list[CandidatePlace]:
    """Sort places by how much of the residual a free curve there would explain, largest first.

    Parameters
    ----------
    frequencies
        Angular frequencies of the waves in functions of time alone.
    """
    if not places:
        return []
    draws = generator.standard_normal((len(residual.residuals), WEIGHTINGS))
    weights = residual.projection.remove(np.column_stack([residual.residuals, draws]))
    variance = float(np.sum(weights[:, 0] ** 2)) / max(residual.projection.degrees, 1)
    names = dict.fromkeys(place.argument for place in places)
    filters = free_filters(trajectories, frequencies)
    waves = tuple(frequencies)[: (HATS - 2) // 2]
    curves = {n: FreeCurve.over(n, trajectories, waves, filters) for n in names}
    sites = {site: tuple(names) for site, names in by_site(places).items()}
    products: dict[EffectSite, FloatArray] = {}
    ends = np.cumsum([0, *(len(trajectory.rows) for trajectory in trajectories)]).tolist()
    for trajectory, (start, stop) in zip(trajectories, pairwise(ends), strict=True):
        signals = adjoint_signals(trajectory, weights[start:stop])
        columns = {name: curve.columns(trajectory) for name, curve in curves.items()}
        stacked = {own: np.hstack([columns[n] for n in own]) for own in set(sites.values())}
        for site, own in sites.items():
            product = stacked[own].T @ _acting(trajectory, signals, site)
            products[site] = products[site] + product if site in products else product
    ranks = {
        CandidatePlace(site, name): _rank(rows, len(site.targets), variance)
        for site, own in sites.items()
        for name, rows in zip(own, np.split(products[site], len(own)), strict=True)
    }
    return sorted(places, key=lambda place: -ranks[place])


@dataclass(frozen=True)
class FreeCurve:
    """A function of one argument, with filters: piecewise linear, or for time a sum of waves.

    The waves have the given angular frequencies, and a constant and a drift are added to them.
    For other arguments, filters are added. Unused coefficients have columns of zeros.
    """

    name: str
    knots: FloatArray = field(repr=False)
    waves: tuple[float, ...]
    filters: tuple[FreeFilter, ...]

    @classmethod
    def over(
        cls,
        name: str,
        trajectories: Sequence[LinearisedTrajectory],
        waves: tuple[float, ...],
        filters: tuple[FreeFilter, ...],
    ) -> Self:
        """Make the curve for all values of an argument."""
        if name == TIME:
            return cls(name, np.zeros(0), waves, filters)
        return cls(name, knots_over(pooled(trajectories, name), HATS), (), filters)

    def columns(self, trajectory: LinearisedTrajectory) -> FloatArray:
        """(n, coefficients): the function with one coefficient at 1 and all others at 0."""
        filtered = sum(each.width for each in self.filters)
        found = np.zeros((len(trajectory.times), HATS + filtered))
        if self.name == TIME:
            t = trajectory.times
            parts = [np.ones_like(t), t, *(f(w * t) for w in self.waves for f in (np.sin, np.cos))]
            found[:, : len(parts)] = np.column_stack(parts)
        elif trajectory.has(self.name):
            signal = trajectory.signal(self.name)
            found[:, : len(self.knots)] = hats(self.knots, signal)
            own = [each.of(trajectory.times, signal) for each in self.filters]
            found[:, HATS:] = np.hstack(own)
        return found


@dataclass(frozen=True)
class FreeFilter:
    """A filter of a signal: a form of the library, a lag or an oscillation, with its shape."""

    form: EffectForm
    shape: tuple[tuple[str, float], ...]

    @property
    def width(self) -> int:
        """Number of its output signals."""
        return len(shape_of(self.form).strengths)

    def of(self, times: FloatArray, signal: FloatArray) -> FloatArray:
        """(n, width): the outputs of the filter."""
        values = dict.fromkeys((c.name for c in self.form.coefficients), 0.0) | dict(self.shape)
        still = np.zeros_like(signal)
        return shape_of(self.form).directions(FormArguments(times, still, signal, still), values)


def free_filters(
    trajectories: Sequence[LinearisedTrajectory], frequencies: Sequence[float]
) -> tuple[FreeFilter, ...]:
    """Return lags over all time scales of the data, and an oscillation if there is a frequency."""
    step = float(np.median(np.concatenate([np.diff(each.times) for each in trajectories])))
    longest = max(float(np.ptp(each.times)) for each in trajectories)
    ends = SHORTEST_LAG * step, max(LONGEST_LAG * longest, SHORTEST_LAG * step)
    lag, swing = FORMS["derivative", "lagged"], FORMS["output", "mode_feed_through"]
    lags = [FreeFilter(lag, (("tau", tau),)) for tau in np.geomspace(*ends, LAGS).tolist()]
    seen = [FreeFilter(swing, (("f", f), ("d", RINGING))) for f in frequencies[:1]]
    return (*lags, *seen)


def _rank(product: FloatArray, states: int, variance: float) -> float:
    """The score statistic of a curve, minus the penalty for its coefficients.

    At a pair of states, a curve acts on each state with its own coefficients.
    """
    block = np.concatenate(np.split(product, states, axis=1))
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
    unbiased = max(count - d - 1, 1) / count  # inverse: T. W. Anderson (2003), lemma 7.7.1
    return float(unbiased * shares.sum()) / max(variance, 1e-300) - COLUMN_PENALTY * (d - 1)


def _acting(
    trajectory: LinearisedTrajectory, signals: AdjointSignals, site: EffectSite
) -> FloatArray:
    """(n, width m): weights of a function at a site; at an input, the function is a factor."""
    if site.kind == "pair":
        return np.hstack([signals.at(site, state) for state in site.targets])
    acting = signals.at(site)
    return acting * trajectory.signal(site.target)[:, None] if site.kind == "input" else acting


@dataclass(frozen=True)
class AdjointSignals:
    """The contribution of a unit term at any site of one experiment to m weighted residual sums.

    Attributes
    ----------
    names
        Names of the outputs.
    at_states, at_outputs : (n, x, m), (n, y, m)
        Weights at state derivatives, and at outputs.
    """

    linear: Linearisation = field(repr=False)
    names: tuple[str, ...]
    at_states: FloatArray = field(repr=False)
    at_outputs: FloatArray = field(repr=False)

    def at(self, site: EffectSite, state: str = "") -> FloatArray:
        """(n, m): weights at a site; at a pair, at the derivative of the given state."""
        linear = self.linear
        if site.kind in ("derivative", "pair"):
            return self.at_states[:, linear.state_names.index(state or site.target)]
        if site.kind == "output":
            if site.target not in self.names:  # not measured in this experiment
                return np.zeros((len(linear.times), self.at_outputs.shape[2]))
            return self.at_outputs[:, self.names.index(site.target)]
        into, through = coupling(linear, site)
        weighed = np.einsum("nx,nxm->nm", into, self.at_states)
        return np.asarray(weighed + np.einsum("ny,nym->nm", through, self.at_outputs))


def adjoint_signals(trajectory: LinearisedTrajectory, weights: FloatArray) -> AdjointSignals:
    """Integrate the adjoint along one experiment, for m weightings of its residuals, (k, m)."""
    linear = trajectory.linear
    if linear is None:
        raise ValueError("the adjoint needs a linearisation")
    n, outputs = trajectory.outputs.shape
    at_outputs = np.zeros((n, outputs, weights.shape[1]))
    places = (trajectory.rows, trajectory.columns)
    np.add.at(at_outputs, places, -weights / trajectory.sigmas[:, None])
    at_states = np.matmul(linear.C.transpose(0, 2, 1), at_outputs)
    weighed = linear_system(linear).weigh(at_states)
    return AdjointSignals(linear, trajectory.names, weighed, at_outputs)
