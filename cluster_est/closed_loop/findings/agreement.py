"""Equations that agree on the range that the data visited: one finding with two names.

v^2 and v|v| are the same where v is never negative, and a switch with the sign of v is a constant
where v never changes it. No search can tell them apart there, so a finding names both, and where
to measure to tell.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cluster_est.closed_loop.findings.effects import AgreeingEquation
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.shapes.effect_shapes import BAND_QUANTILE
from workers.effects.laws import Law
from workers.effects.site import bracketed
from workers.messages import FloatArray

Shape = Callable[[FloatArray], FloatArray]

CLOSE = 0.1
"""Share of an effect's largest size that another equation may be off anywhere in the data."""

CLEARLY_DIFFERENT = 0.25
"""Share of that size by which two equations must differ somewhere, to be told apart there."""

BEYOND = 1.5
"""Times the largest absolute value in the data up to which it is looked where two differ."""

MOST_AGREEING = 3
"""Equations that are named beside the one that was found."""


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
"""Laws with a strength alone: one more coefficient could imitate anything."""


def agreements(
    curve: EffectCurve,
    shape: Shape,
    own: Law,
    named: Callable[[Law], str],
    *,
    negative: bool = True,
) -> tuple[AgreeingEquation, ...]:
    """Return equations that agree with a found effect wherever the data were; the closest first.

    Each is fitted to the curve of the effect over the samples. It agrees if what is left is smaller
    than the effect's own standard error, both as root mean squares over the samples, and nowhere
    more than a tenth of the effect's largest size. Laws that differ from it nowhere are the same
    equation written in another way, and are not named.

    Parameters
    ----------
    curve
        Of the effect, with its band.
    shape
        The same curve as a function, also outside the range of the data.
    own, named
        The law of the effect, and what physics calls another one at its place.
    negative
        The variable can be negative at all.
    """
    x, weights = _visited(curve)
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
        apart = float(np.sqrt(np.average(off**2, weights=weights)))
        if apart > error or off.max() > CLOSE * size:
            continue
        told = _told_apart(curve, shape, other, strength, size, negative=negative)
        if told is not None:
            largest = float(off.max())
            equation = f"{strength:.4g} * {text.format(v=bracketed(curve.variable))}"
            known = (equation.removesuffix(" * 1"), named(law), largest, largest / size)
            found.append((apart, AgreeingEquation(*known, *told)))
    return tuple(each for _, each in sorted(found, key=lambda pair: pair[0])[:MOST_AGREEING])


def _visited(curve: EffectCurve) -> tuple[FloatArray, FloatArray]:
    """Middles of the bins that have samples, and how many."""
    middles = 0.5 * (curve.edges[1:] + curve.edges[:-1])
    return middles[curve.counts > 0.0], curve.counts[curve.counts > 0.0]


def _standard_error(curve: EffectCurve, x: FloatArray, weights: FloatArray) -> float:
    """Of the effect, as a root mean square over the samples; 0 where the band is not known."""
    half = 0.5 * (curve.upper - curve.lower) / BAND_QUANTILE
    if not np.isfinite(half).all():
        return 0.0
    there = np.interp(x, curve.x, half)
    return float(np.sqrt(np.average(there**2, weights=weights)))


def _told_apart(
    curve: EffectCurve, one: Shape, other: Shape, strength: float, size: float, *, negative: bool
) -> tuple[float, float] | None:
    """The value nearest to the data at which two laws clearly differ, and by how much."""
    low, high = float(curve.edges[0]), float(curve.edges[-1])
    far = BEYOND * max(abs(low), abs(high))
    x = np.linspace(-far if negative else 0.0, far, 1201)
    apart = np.abs(one(x) - strength * other(x))
    clear = np.isfinite(apart) & (apart >= CLEARLY_DIFFERENT * size)
    if not clear.any():
        return None
    distance = np.maximum(np.maximum(low - x, x - high), 0.0)
    best = int(np.argmin(np.where(clear, distance, np.inf)))
    return float(x[best]), float(apart[best])
