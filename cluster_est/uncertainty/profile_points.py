"""The points of a likelihood profile, the choice of the next point, and the ends of the profile."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np

from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray
from workers.messages.types import by_content


class ProfileEnd(enum.StrEnum):
    """How one side of a profile ends, or why it has no end; the values are texts in tables."""

    FOUND = ""
    BOUND = "bound"
    FLAT = "flat"
    FAILED = "failed"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class ProfilePoint:
    """A refit: the fixed value, the cost, and all unknowns, in physical units.

    `root` is the signed square root of the cost increase; it is -1 and 1 at the interval's ends.
    """

    value: float
    cost: float
    root: float
    estimates: tuple[float, ...]


@by_content
@dataclass(frozen=True)
class ProfileResult:
    """The profile of one unknown.

    Attributes
    ----------
    label, value, cost
        Label of the unknown, its estimate, and the cost at the estimate.
    rise, confidence
        Increase of the cost at the ends of the interval, and the confidence of the interval.
    points
        Points from low to high values, with the optimum; `labels` belong to their estimates.
    lower, upper
        The ends of the interval, in physical units. A missing end is infinite, or NaN if refits
        failed. `open_lower` or `open_upper` is then the reason. "bound": the profile reaches the
        unknown's bound first. "flat": it never rises enough. "failed": refits failed. "unknown":
        the residuals do not determine how far the cost may rise.
    better
        (estimates, cost) of a point that is better than the optimum; None without such a point.
    """

    label: str
    value: float
    cost: float
    rise: float
    confidence: float
    labels: tuple[str, ...] = field(repr=False)
    points: tuple[ProfilePoint, ...] = field(repr=False)
    lower: float
    upper: float
    open_lower: ProfileEnd
    open_upper: ProfileEnd
    better: tuple[dict[str, float], float] | None = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on missing ends, and on a better minimum."""
        ends = [
            ("lower", self.open_lower, self.points[0]),
            ("upper", self.open_upper, self.points[-1]),
        ]
        if self.open_lower is ProfileEnd.UNKNOWN:
            return (
                f"{self.label} has no profile, because the residuals do not determine how far the "
                "cost may rise; set uncertainty.rise",
            )
        found = [
            _sentence(self.label, side, end, point.value)
            for side, end, point in ends
            if end is not ProfileEnd.FOUND
        ]
        if self.better is not None:
            found.append(
                f"{self.label}: the computation of its profile found a better minimum (cost "
                f"{self.better[1]:.6g} instead of {self.cost:.6g}); fit again from this minimum"
            )
        return tuple(found)


def _sentence(label: str, side: str, end: ProfileEnd, value: float) -> str:
    if end is ProfileEnd.BOUND:
        return f"{label} has no {side} limit: its profile reaches the bound {value:.6g} first"
    if end is ProfileEnd.FLAT:
        return f"{label} has no {side} limit: the cost does not rise enough up to {value:.6g}"
    return f"{label} has no {side} limit: the refits beyond {value:.6g} failed or were stopped"


CLOSE_TO_INTERVAL_END = 1e-3
"""Largest distance of a point from the interval's end, in units of the root."""
NARROW_BRACKET = 1e-6
"""Relative width of a bracket that counts as the end of an almost vertical profile."""
GROWTH = 3.0
LONGEST_LOG = 2.3
"""Largest step of a logarithm: a factor of ten."""


@dataclass(frozen=True)
class RefitPoint:
    """A point of a profile: the unknowns, the cost and its root.

    The root is the square root of the cost increase over the increase at the interval's end. It is
    0 at the optimum and 1 at the end. If the model is linear, it is linear in between.
    """

    x: FloatArray
    cost: float
    root: float


@dataclass(frozen=True)
class ProfileTarget:
    """The side of a profile to compute.

    Attributes
    ----------
    unknown
        Index of the profiled unknown.
    direction
        1 for upwards, -1 for downwards.
    cost, rise
        Cost at the optimum, and its increase at the interval's end.
    steps, max_steps
        See `UncertaintySettings`.
    """

    unknown: int
    direction: int
    cost: float
    rise: float
    steps: int = 4
    max_steps: int = 20

    def root(self, cost: float) -> float:
        """Return the root (see `RefitPoint`) of a cost."""
        return float(np.sqrt(max(cost - self.cost, 0.0) / self.rise))


@dataclass
class ProfileSteps:
    """The points of one side of a profile, and the choice of the next one.

    Attributes
    ----------
    target, space
        The side of the profile, and its search space.
    inside, outside
        The points inside the interval, in order, and the nearest point outside.
    points
        All points, in the order in which they were added.
    length
        Length of the next step outwards.
    factor
        Share of a step that is taken after a failure.
    bisect
        Whether the last step towards the end reduced the bracket by less than half.
    """

    target: ProfileTarget
    space: SearchSpace
    inside: list[RefitPoint]
    length: float
    outside: RefitPoint | None = None
    factor: float = 1.0
    bisect: bool = False
    points: list[RefitPoint] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.points = list(self.inside)

    @property
    def bracket(self) -> float:
        """Distance between the last point inside and the first point outside."""
        i = self.target.unknown
        end = np.inf if self.outside is None else float(self.outside.x[i])
        return abs(end - float(self.inside[-1].x[i]))

    def next_value(self) -> float | None:
        """Return the unknown's next value; None if the end is known or a bound is reached."""
        last = float(self.inside[-1].x[self.target.unknown])
        outside = self.outside
        value = self._extrapolated(last) if outside is None else self._interpolated(outside, last)
        if value is None or value == last:
            return None
        return last + self.factor * (value - last) if self.factor < 1.0 else value

    def _extrapolated(self, last: float) -> float:
        i = self.target.unknown
        value = last + self.target.direction * self.length
        return float(np.clip(value, self.space.lower[i], self.space.upper[i]))

    def _interpolated(self, outside: RefitPoint, last: float) -> float | None:
        """Return a value between the last point inside and the point outside."""
        inside, part = self.inside[-1], 1.0 / self.target.steps
        end = float(outside.x[self.target.unknown])
        if (
            outside.root <= 1.0 + CLOSE_TO_INTERVAL_END
            or inside.root >= 1.0 - CLOSE_TO_INTERVAL_END
        ):
            return None
        if self.bracket <= NARROW_BRACKET * abs(end - float(self.inside[0].x[self.target.unknown])):
            return None
        if self.bisect:
            return 0.5 * (last + end)
        close = 1.0 - inside.root <= 1.5 * part
        root = 1.0 if close else inside.root + part
        value = crossing([*self.inside, outside], self.target.unknown, root)
        margin = 0.01 * (end - last)
        low, high = sorted([last + margin, end - margin])
        return float(np.clip(value, low, high))

    def predicted(self, value: float) -> FloatArray:
        """Return start values for the refit at a value, by extrapolation of the last two points."""
        i, last = self.target.unknown, self.inside[-1]
        x = last.x.copy()
        if len(self.inside) > 1:
            before = self.inside[-2]
            width = last.x[i] - before.x[i]
            x += (value - last.x[i]) / width * (last.x - before.x)
        x = np.clip(x, self.space.lower, self.space.upper)
        x[i] = value
        return x

    def add(self, x: FloatArray, cost: float) -> None:
        """Add a point and choose the length of the next step."""
        point, last = RefitPoint(x, cost, self.target.root(cost)), self.inside[-1]
        bracket = self.bracket
        self.points.append(point)
        self.factor = 1.0
        if point.root >= 1.0:
            self.outside = point
        else:
            self.inside.append(point)
            self.length = self._next_length(last, point)
        may_bisect = bool(np.isfinite(bracket)) and not self.bisect
        self.bisect = self.bracket > 0.5 * bracket if may_bisect else False

    def _next_length(self, last: RefitPoint, point: RefitPoint) -> float:
        """Return the step that probably increases the root by the intended amount."""
        i = self.target.unknown
        width, rise = abs(float(point.x[i] - last.x[i])), point.root - last.root
        wanted = min(1.0 / self.target.steps, max(1.02 - point.root, CLOSE_TO_INTERVAL_END))
        factor = wanted / rise if rise > 0.0 else GROWTH
        longest = LONGEST_LOG if self.space.unknowns[i].log else np.inf
        return min(width * min(max(factor, 1.0 / GROWTH), GROWTH), longest)


def crossing(path: list[RefitPoint], i: int, root: float) -> float:
    """Return the value of unknown i at a root, between the last two points of a path.

    Inverse quadratic interpolation of the last three points is used if it is monotonic there,
    linear interpolation otherwise.
    """
    a, b = path[-2], path[-1]
    x_a, x_b = float(a.x[i]), float(b.x[i])
    share = (root - a.root) / (b.root - a.root)
    linear = x_a + share * (x_b - x_a)
    if len(path) < 3 or not path[-3].root < a.root < b.root:
        return linear
    c = path[-3]
    slope_ab = (x_b - x_a) / (b.root - a.root)
    slope_ca = (x_a - float(c.x[i])) / (a.root - c.root)
    curvature = (slope_ab - slope_ca) / (b.root - c.root)
    quadratic = linear + curvature * (root - a.root) * (root - b.root)
    low, high = sorted([x_a, x_b])
    return quadratic if low <= quadratic <= high else linear
