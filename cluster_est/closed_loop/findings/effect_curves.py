"""Curves of the effects that were found: estimates from the residuals, and equations that agree.

If v is far from zero, a switch with the sign of v is a constant, and over a narrow range a square
is a line. No search can distinguish them on such data. So a finding names both equations, and says
where a measurement would distinguish them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import (
    LinearisedTrajectory,
    hats,
    integrated_states,
    knots_over,
    pooled,
)
from cluster_est.closed_loop.findings.effects import AgreeingEquation
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import residual_change
from cluster_est.errors import ClusterEstError
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.result import Result
from cluster_est.results.shapes.effect_shapes import BAND_QUANTILE, effect_shapes, with_evidence
from workers.effects.laws import Law
from workers.effects.site import EffectSite, bracketed, difference, split_variable
from workers.messages import FloatArray


def effect_curves(fitter: Fitter, fitted: FittedModel, result: Result) -> tuple[EffectCurve, ...]:
    """Compute the curves of all effects of the final model.

    The experiments are simulated once more with the final model, because the curves need the ranges
    of the signals, and the sensitivities to free values.
    """
    if not fitted.added:
        return ()
    try:
        trajectories = fitter.trajectories(fitted)
    except ClusterEstError as error:
        why = f"the experiments cannot be simulated ({error})"
        return tuple(EffectCurve(c.effect.name, str(c.site), why_not=why) for c in fitted.added)

    def visited(site: EffectSite, name: str) -> FloatArray:
        found = [arguments(each, site, name) for each in trajectories]
        return np.concatenate([each for each in found if each is not None] or [np.zeros(0)])

    curves = effect_shapes(result, fitter.description, visited)
    sites = {c.effect.name: c.site for c in fitted.added}
    # free values are computed by the linear systems, which a Kalman filter would change
    residuals = None if fitter.predicts else fitted.residuals
    return tuple(_shown(each, sites.get(each.effect), trajectories, residuals) for each in curves)


def arguments(trajectory: LinearisedTrajectory, site: EffectSite, name: str) -> FloatArray | None:
    """Return the values of an effect's argument in an experiment; None if it has none.

    If the argument is the signal that the effect changes, the values are those before the change.
    """
    if name == "time":
        return trajectory.times
    if site.kind == "input" and name == site.target and name in trajectory.driven:
        return trajectory.driven[name]
    if site.kind == "output" and name == site.target:
        known = name in trajectory.names
        return trajectory.outputs[:, trajectory.names.index(name)] if known else None
    return pooled([trajectory], name) if trajectory.has(name) else None


def _shown(
    curve: EffectCurve,
    site: EffectSite | None,
    trajectories: Sequence[LinearisedTrajectory],
    residuals: FloatArray | None,
) -> EffectCurve:
    """Return a curve with its free values, if these can be estimated."""
    if curve.why_not or curve.positive or site is None:
        return curve
    values = [arguments(each, site, curve.variable) for each in trajectories]
    found = None if residuals is None else free_values(site, trajectories, values, residuals)
    curve = replace(curve, integral_of=_integral_of(curve.variable, trajectories))
    return curve if found is None else with_evidence(curve, *found)


def _integral_of(name: str, trajectories: Sequence[LinearisedTrajectory]) -> str:
    """Return the state whose integral a variable is; for a difference, the difference of states."""
    speeds = {x: v for x, (v, _) in integrated_states(trajectories).items()}
    parts = [speeds[x] for x in split_variable(name, speeds)]
    return difference(*parts) if len(parts) > 1 else "".join(parts)


PLACES = 12
"""Number of points of a free function; more points would not be visible in a plot."""

DETERMINED = 1e-8
"""Least squared length of a point's sensitivity, as a share of the largest one."""


def free_values(
    site: EffectSite,
    trajectories: Sequence[LinearisedTrajectory],
    arguments: Sequence[FloatArray | None],
    residuals: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Fit a piecewise linear function of an argument to the residuals of a fit.

    Parameters
    ----------
    arguments : (n,) for each trajectory
        Values of the argument; None if an experiment does not have it.
    residuals : (N,)
        Residuals of all training experiments, divided by sigma.

    Returns
    -------
    Points of the argument, values there, and standard errors that assume white noise, each
    (points,). None for a pair of derivatives, or if the interface does not allow it.
    """
    if site.kind == "pair" or (site.kind != "output" and trajectories[0].linear is None):
        return None
    known = np.concatenate([each for each in arguments if each is not None] or [np.zeros(0)])
    if not len(known) or not np.ptp(known) > 0.0:
        return None
    at = knots_over(known, PLACES)
    parts = []
    for each, values in zip(trajectories, arguments, strict=True):
        added = np.zeros((len(each.times), len(at))) if values is None else hats(at, values)
        parts.append(residual_change(each, site, added))
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


Shape = Callable[[FloatArray], FloatArray]

CLOSE = 0.1
"""Two equations agree if they differ nowhere in the data by more than this share of the effect."""

CLEARLY_DIFFERENT = 0.25
"""A measurement distinguishes two equations where they differ by at least this share."""

BEYOND = 0.5
"""How far beyond the data a difference is searched, relative to their largest absolute value. By
definition: a system can hardly be operated at far larger values."""

MOST_AGREEING = 3
"""Largest number of equations that are named in addition to the one that was found."""


THRESHOLDS: dict[Law, tuple[str, bool]] = {
    Law.SATURATION: ("limit", True), Law.DEAD_ZONE: ("k", True), Law.CUT_OFF: ("k", True),
    Law.GAP: ("at", True), Law.CLIPPED: ("at", True), Law.ABOVE: ("at", False),
    Law.BELOW: ("at", False), Law.ABOVE_BY_POWER: ("at", False),
    Law.LIMIT_ABOVE: ("limit", False), Law.LIMIT_BELOW: ("limit", False),
}  # fmt: skip
"""By law with a threshold: the coefficient of the threshold, and whether there is a second one with
the opposite sign. Only the data on both sides of a threshold show it."""


def missed_thresholds(
    law: Law, coefficients: Mapping[str, float], curve: EffectCurve | None
) -> list[float]:
    """Return the thresholds of a law that the argument of an effect does not pass in the data."""
    name, both = THRESHOLDS.get(law, ("", False))
    at = coefficients.get(name, np.nan)
    if curve is None or not len(curve.x) or not np.isfinite(at):
        return []
    low, high = float(curve.x.min()), float(curve.x.max())
    return [x for x in ((at, -at) if both else (at,)) if not low < x < high]


ONE_SIDE = {
    Law.SATURATION: (Law.LIMIT_BELOW, Law.LIMIT_ABOVE),
    Law.GAP: (Law.BELOW, Law.ABOVE),
}
"""Laws with two thresholds, and what the data show if they pass only the lower or the upper one."""
ONE_THRESHOLD = (Law.ABOVE, Law.BELOW, Law.ABOVE_BY_POWER)
"""Laws with one threshold. Data on one side of it show a simpler law."""


def law_of_one_side(law: Law, missed: Sequence[float]) -> Law:
    """Return the law that the data show if they do not pass one of two thresholds."""
    return ONE_SIDE[law][missed[0] < 0.0] if len(missed) == 1 and law in ONE_SIDE else law


LAWS: dict[Law, tuple[str, Shape]] = {
    Law.CONSTANT: ("1", np.ones_like),
    Law.LINEAR: ("{v}", lambda x: x),
    Law.SQUARE: ("{v}^2", np.square),
    Law.ODD_SQUARE: ("{v} * abs({v})", lambda x: x * np.abs(x)),
    Law.CUBE: ("{v}^3", lambda x: x**3),
    Law.ABSOLUTE: ("abs({v})", np.abs),
    Law.SWITCH: ("sign({v})", np.sign),
    Law.ROOT: ("sqrt(max({v}, 0))", lambda x: np.sqrt(np.maximum(x, 0.0))),
    Law.ODD_ROOT: ("sign({v}) * sqrt(abs({v}))", lambda x: np.sign(x) * np.sqrt(np.abs(x))),
}
"""Laws whose only coefficient is a strength; with a second one, a law could imitate any other."""


def agreements(
    curve: EffectCurve,
    shape: Shape,
    own: Law,
    named: Callable[[Law], str],
) -> tuple[AgreeingEquation, ...]:
    """Return equations that agree with a found effect wherever the data were; the closest first.

    Each law is fitted to the curve of the effect over the samples. It agrees if the difference is
    smaller than the effect's own standard error, both as root mean squares over the samples, and
    never above a tenth of the effect's largest size. A law that differs clearly nowhere, even
    moderately beyond the data, is the same equation written in another way, and is not named: if v
    is never negative, v|v| is v^2.

    Parameters
    ----------
    shape
        The same curve as a function, also outside the range of the data.
    own, named
        The law of the effect, and a function that returns the physical name of another law there.
    """
    visited = curve.counts > 0.0
    x, weights = 0.5 * (curve.edges[1:] + curve.edges[:-1])[visited], curve.counts[visited]
    y = shape(x)
    size = float(np.abs(y).max(initial=0.0))
    if len(x) < 3 or curve.variable == "time" or not np.isfinite(y).all() or not size > 0.0:
        return ()
    error = max(_standard_error(curve, x, weights), 1e-9 * size)
    found = []
    for law, (text, other) in LAWS.items():
        column = other(x)
        square = float(np.sum(weights * column**2))
        if law is own or not square > 0.0:
            continue
        strength = float(np.sum(weights * column * y)) / square
        off = np.abs(y - strength * column)
        apart, largest = float(np.sqrt(np.average(off**2, weights=weights))), float(off.max())
        if apart > error or largest > CLOSE * size:
            continue
        told = _told_apart(curve, shape, other, strength, size)
        if told is not None:
            equation = f"{strength:.4g} * {text.format(v=bracketed(curve.variable))}"
            known = (equation.removesuffix(" * 1"), named(law), largest, largest / size)
            found.append((apart, AgreeingEquation(*known, *told)))
    return tuple(each for _, each in sorted(found, key=lambda pair: pair[0])[:MOST_AGREEING])


def _standard_error(curve: EffectCurve, x: FloatArray, weights: FloatArray) -> float:
    """Root mean square of the effect's standard error over the samples; 0 if it is not known."""
    half = 0.5 * (curve.upper - curve.lower) / BAND_QUANTILE
    if not np.isfinite(half).all():
        return 0.0
    there = np.interp(x, curve.x, half)
    return float(np.sqrt(np.average(there**2, weights=weights)))


def _told_apart(
    curve: EffectCurve, one: Shape, other: Shape, strength: float, size: float
) -> tuple[float, float] | None:
    """Return the value nearest to the data at which two laws clearly differ, and the difference.

    A signal that did not change its sign is not expected to do so: an amount or a pressure cannot.
    """
    low, high = float(curve.edges[0]), float(curve.edges[-1])
    beyond = BEYOND * max(abs(low), abs(high))
    first, last = low - beyond, high + beyond
    x = np.linspace(
        max(first, 0.0) if low >= 0.0 else first, min(last, 0.0) if high <= 0.0 else last, 1201
    )
    apart = np.abs(one(x) - strength * other(x))
    clear = np.isfinite(apart) & (apart >= CLEARLY_DIFFERENT * size)
    if not clear.any():
        return None
    distance = np.maximum(np.maximum(low - x, x - high), 0.0)
    best = int(np.argmin(np.where(clear, distance, np.inf)))
    return float(x[best]), float(apart[best])
