"""Places before forms: sites with an argument, ranked by what a free curve there would explain.

Where there are too many candidates to compare each with the residual, those at the leading places
are. The curve is piecewise linear in the argument, and beside it stand filters of the argument,
some lags and an oscillation, for what remembers: a hidden store at a place is little of a function
there, and would be looked for where one happens to follow it. All experiments share one set of
coefficients. With D their directions outside the declared parameters, and r the residual, it
explains b'(D'D)^-1 b, b = D'r. The adjoint gives b at all places from one integration: for a
weighting w of the residuals w'(D f) = (D'w)'f, and D'w follows at every site at once by integrating
backwards. D'D follows from some random weightings z more: E[D'z z'D] = D'D (M. F. Hutchinson,
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
    """Thresholds of the ranking of places, where there are too many candidates to look at each.

    Attributes
    ----------
    most_candidates
        Candidates above which only those at leading places are looked at. Memory: see `most_rows`.
    leading
        Places that are looked at. Benchmark.
    """

    most_candidates: int = 1500
    leading: int = 40


LEADING_PLACES = PlaceThresholds()

HATS = 9
"""Coefficients of the curve that stands for every form without a memory."""
LAGS = 4
"""Time constants of filters, at equal ratios: what lies between two is a mixture of them."""
SHORTEST_LAG, LONGEST_LAG = 3.0, 1.0 / 3.0
"""The shortest of them, in steps, and the longest, of the longest record. Signal: a faster one is a
gain of the argument, a slower one its integral."""
RINGING = 0.1
"""Damping of the oscillation, which is at the first peak of the residual's spectrum. Signal: much
less rings for all of a record, much more is a lag."""
WEIGHTINGS = 160
"""Random weightings that estimate the size of a direction: the relative error of its square is the
root of 2 over their number. Benchmark: with 96, one in ten of the stores hidden in a rod of twelve
nodes is not among the leading places, with 160 none."""
COLUMN_PENALTY = 8.0
"""Rise of the statistic that each further column of a candidate, or coefficient of a curve, must
bring to be ranked as high. Benchmark; its mean is 1 where the column means nothing (theory:
chi-squared)."""


DEPENDENT = 1e-6
"""Smallest eigenvalue of D'D, over the largest, of a direction that counts: knots may coincide."""


def rank_places(
    places: Sequence[CandidatePlace],
    trajectories: Sequence[LinearisedTrajectory],
    residual: ProjectedResidual,
    frequencies: Sequence[float],
    generator: np.random.Generator,
) -> list[CandidatePlace]:
    """Order places by what a free curve there would explain of the residual, the most first.

    Parameters
    ----------
    frequencies
        Angular frequencies of the waves among what depends on time alone.
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
    """A function of one argument: piecewise linear, or where that is time, a sum of waves.

    These have angular frequencies, and come beside a constant and a drift. Filters of the argument
    come beside the function. Coefficients that are not needed have columns of zeros.
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
        """Over all values of an argument."""
        if name == TIME:
            return cls(name, np.zeros(0), waves, filters)
        return cls(name, knots_over(pooled(trajectories, name), HATS), (), filters)

    def columns(self, trajectory: LinearisedTrajectory) -> FloatArray:
        """(n, coefficients): the function with each of them at 1 and all others at 0."""
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
    """A filter of a signal by a form of the library, with its shape: a lag, or an oscillation."""

    form: EffectForm
    shape: tuple[tuple[str, float], ...]

    @property
    def width(self) -> int:
        """Number of its signals."""
        return len(shape_of(self.form).strengths)

    def of(self, times: FloatArray, signal: FloatArray) -> FloatArray:
        """(n, width): what comes out of it."""
        values = dict.fromkeys((c.name for c in self.form.coefficients), 0.0) | dict(self.shape)
        still = np.zeros_like(signal)
        return shape_of(self.form).directions(FormArguments(times, still, signal, still), values)


def free_filters(
    trajectories: Sequence[LinearisedTrajectory], frequencies: Sequence[float]
) -> tuple[FreeFilter, ...]:
    """Return lags over all scales of time that the data know, and an oscillation if any is seen."""
    step = float(np.median(np.concatenate([np.diff(each.times) for each in trajectories])))
    longest = max(float(np.ptp(each.times)) for each in trajectories)
    ends = SHORTEST_LAG * step, max(LONGEST_LAG * longest, SHORTEST_LAG * step)
    lag, swing = FORMS["derivative", "lagged"], FORMS["output", "mode_feed_through"]
    lags = [FreeFilter(lag, (("tau", tau),)) for tau in np.geomspace(*ends, LAGS).tolist()]
    seen = [FreeFilter(swing, (("f", f), ("d", RINGING))) for f in frequencies[:1]]
    return (*lags, *seen)


def _rank(product: FloatArray, states: int, variance: float) -> float:
    """The score statistic of a curve, less the price of its coefficients.

    At a pair of states a curve acts on each of them with coefficients of its own.
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
    unbiased = max(count - d - 1, 1) / count  # of an inverse, T. W. Anderson (2003), lemma 7.7.1
    return float(unbiased * shares.sum()) / max(variance, 1e-300) - COLUMN_PENALTY * (d - 1)


def _acting(
    trajectory: LinearisedTrajectory, signals: AdjointSignals, site: EffectSite
) -> FloatArray:
    """(n, width m): what a function at a site weighs with; at an input it multiplies the signal."""
    if site.kind == "pair":
        return np.hstack([signals.at(site, state) for state in site.targets])
    acting = signals.at(site)
    return acting * trajectory.signal(site.target)[:, None] if site.kind == "input" else acting


@dataclass(frozen=True)
class AdjointSignals:
    """Along one experiment, what is added at any site weighs with these in m weighted sums.

    Attributes
    ----------
    names
        Of the outputs.
    at_states, at_outputs : (n, x, m), (n, y, m)
        At state derivatives, and at outputs.
    """

    linear: Linearisation = field(repr=False)
    names: tuple[str, ...]
    at_states: FloatArray = field(repr=False)
    at_outputs: FloatArray = field(repr=False)

    def at(self, site: EffectSite, state: str = "") -> FloatArray:
        """(n, m): at a site, at a pair at the derivative of one of its states."""
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
