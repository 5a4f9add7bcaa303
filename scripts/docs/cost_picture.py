"""The picture of the page on costs and constraints, from the library's own costs and limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from docs.svg import Axes, document, lines, text

from cluster_est.config.constraints import signal_bound, tracking_bands
from cluster_est.config.sections import ConstraintSection
from cluster_est.problem.costs import COSTS
from workers.messages import FloatArray, Output, SignalBound

WIDTH, HEIGHT = 860, 644
STOP = 10.0
TIMES = np.linspace(0.0, STOP, 201)

STYLE = """
.scale { stroke: var(--edge); stroke-dasharray: 3 3; fill: none; }
.allowed { fill: var(--allowed); stroke: var(--c2); stroke-width: 1; }
.measured { stroke: var(--ink); stroke-width: 4; stroke-linecap: round; fill: none; }
.over { stroke: var(--c1); stroke-width: 4; fill: none; }
.axis { stroke: var(--edge); fill: none; }
"""

NAMED = {
    "sse": "squares, the default",
    "huber": "squares up to scale, then straight",
    "soft_l1": "the same, with a smooth passage",
    "sae": "absolute values",
    "cauchy": "large residuals hardly count",
}
"""The costs that are a sum over single residuals."""


@dataclass(frozen=True)
class Limit:
    """A constraint on a signal, and a simulation that does not satisfy it.

    Attributes
    ----------
    key, words
        As a config names it, and what it is.
    bound
        What a worker is given.
    simulated
        At `TIMES`.
    measured
        For a band around it.
    """

    key: str
    words: tuple[str, str]
    bound: SignalBound
    simulated: FloatArray
    measured: Output | None = None

    @property
    def worst(self) -> tuple[float, float, float]:
        """The largest violation: when it is, the limit then, and the signal."""
        signal = np.interp(self.bound.times, TIMES, self.simulated)
        over, under = signal - self.bound.upper, self.bound.lower - signal
        at = int(np.argmax(np.maximum(over, under)))
        limit = self.bound.upper if over[at] >= under[at] else self.bound.lower
        return float(self.bound.times[at]), float(limit[at]), float(signal[at])


def picture() -> str:
    """What costs make of a residual, and what limits a signal may have, as SVG."""
    parts = costs()
    parts.append(text(24, 366, "Constraints on a simulated signal, over time", "head"))
    for number, limit in enumerate(limits()):
        parts += drawn(limit, 24 + 208 * number)
    parts += [
        '<path class="allowed" d="M24 611h22v12h-22z"/>',
        text(52, 622, "allowed"),
        '<path class="line c0" d="M124 617h22"/>',
        text(152, 622, "simulated"),
        '<path class="measured" d="M236 617h0m8 0h0m8 0h0"/>',
        text(262, 622, "measured"),
        '<path class="over" d="M346 610v14"/>',
        text(
            356, 622, "the largest violation; over the scale of the constraint it must be at most 0"
        ),
    ]
    title = "What the costs make of a residual, and four kinds of limits of a signal"
    return document((WIDTH, HEIGHT), title, STYLE, parts)


def costs() -> list[str]:
    """The cost of one residual, for each cost with its own default options."""
    axes = Axes(60, 560, 68, 290, (-6.0, 6.0), (0.0, 12.0))
    parts = [
        text(24, 28, "What each cost makes of one residual", "head"),
        *axes.rules((0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0)),
        *axes.numbers((-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)),
        text(310, 328, "residual: (measured - simulated) / sigma", anchor="middle"),
        *(f'<path class="scale" d="M{axes.across(at):.1f} 68V290"/>' for at in (-1.0, 1.0)),
        text(310, 62, "scale = 1", anchor="middle"),
    ]
    for number, (name, words) in enumerate(NAMED.items()):
        residuals, values = cost_curve(name)
        seen = values <= axes.y[1]
        kind = f"line c{number}"
        parts.append(axes.curve(residuals[seen], values[seen], kind))
        label = f'<tspan class="head">{name}</tspan>: {words}'
        if seen[-1]:
            parts.append(text(568, axes.down(values[-1]) + 4, label))
        else:
            parts.append(text(axes.across(residuals[seen][-1]) - 6, 62, label))
    return parts


def cost_curve(name: str) -> tuple[FloatArray, FloatArray]:
    """Residuals in sigmas, and the cost of each of them alone."""
    cost, residuals = COSTS[name](), np.linspace(-6.0, 6.0, 241)
    one = np.zeros(1, np.int64)
    return residuals, np.array([cost.value(residuals[i : i + 1], one) for i in range(241)])


def limits() -> list[Limit]:
    """Every kind of limit of a signal that a config can name."""
    ramp = {"lower": 0.1, "upper": [[0.0, 0.6], [3.0, 1.15], [10.0, 1.15]]}
    envelope = {"final": 1.0, "rise_time": 3.0, "settling_time": 7.0, "settling": 8.0}
    envelope |= {"overshoot": 20.0, "undershoot": 5.0}
    times = np.linspace(0.5, 9.5, 19)
    measured = Output("y", times, 0.65 + 0.4 * np.sin(0.9 * times) + 0.03 * np.sin(31.0 * times))
    band = _section(tracking={"absolute": 0.15})
    assert band.tracking is not None
    (tracked,) = tracking_bands(band, band.tracking, 0.0, STOP, [measured])
    follower = 0.65 + 0.4 * np.sin(0.9 * TIMES) + 0.27 * np.exp(-((TIMES - 5.6) ** 2))
    return [
        Limit(
            "lower, upper",
            ("a number, or corners of", "straight lines over time"),
            _bound(**ramp),
            0.12 + step_response(0.9, 0.32, TIMES),
        ),
        Limit(
            "step_response",
            ("rise, overshoot, settling:", "the envelope of a step"),
            _bound(step_response=envelope),
            step_response(1.1, 0.35, TIMES),
        ),
        Limit(
            "tracking",
            ("a band around what was", "measured, at its times"),
            tracked,
            follower,
            measured,
        ),
        Limit(
            "final, tolerance",
            ("the value at the end", "of the simulation"),
            _bound(final=1.0, tolerance=0.08),
            step_response(0.15, 1.0, TIMES),
        ),
    ]


def step_response(frequency: float, damping: float, times: FloatArray) -> FloatArray:
    """The answer of an oscillator to a step of 1; with a damping of 1 that of a lag."""
    if damping >= 1.0:
        return np.asarray(1.0 - np.exp(-frequency * times))
    free = frequency * np.sqrt(1.0 - damping**2)
    sine = damping * frequency / free * np.sin(free * times)
    decay = np.exp(-damping * frequency * times)
    return np.asarray(1.0 - decay * (np.cos(free * times) + sine))


def _section(**keys: object) -> ConstraintSection:
    return ConstraintSection.model_validate({"signal": "y", **keys})


def _bound(**keys: object) -> SignalBound:
    return signal_bound(_section(**keys), "constraints[0]", 0.0, STOP)


def drawn(limit: Limit, left: float) -> list[str]:
    """One kind of limit, with its name above and its largest violation."""
    axes = Axes(left, left + 186, 448, 584, (0.0, STOP), (-0.1, 1.6))
    bound = limit.bound
    inside = np.isfinite(bound.lower) & np.isfinite(bound.upper)
    times, low, high = bound.times[inside], bound.lower[inside], bound.upper[inside]
    if len(times) == 1:  # at the end alone: as wide as can be seen
        times, low, high = times - [0.4, 0.0], low.repeat(2), high.repeat(2)
    at, allowed, reached = limit.worst
    ends = axes.down(allowed), axes.down(reached)
    seen = [] if limit.measured is None else [limit.measured]
    return [
        text(left, 396, limit.key, "small head"),
        *lines(left, 414, limit.words),
        axes.area(times, low, high, "allowed"),
        f'<path class="axis" d="M{left} 448V584H{left + 186}"/>',
        *(axes.dots(each.times, each.values, "measured") for each in seen),
        axes.curve(TIMES, limit.simulated, "line c0"),
        f'<path class="over" d="M{axes.across(at):.1f} {ends[0]:.1f}V{ends[1]:.1f}"/>',
    ]
