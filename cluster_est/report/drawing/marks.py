"""What is drawn in a plot. Each mark makes paths; colours and widths are those of its CSS class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, final

import numpy as np
from markupsafe import Markup

from cluster_est.report.drawing import path
from cluster_est.report.drawing.scale import UNITS, Scale
from workers.messages import FloatArray

PATH = Markup('<path class="{} {}"{} d="{}"/>')
LEVELS = 5
"""Shades of `Cells`."""


class Mark(ABC):
    """A mark: what it shows, its ink (a CSS class that names a colour), and its paths.

    `kind` is the CSS class of its paths; marks that `read` are read off under the pointer.
    """

    name: str
    ink: str
    kind: ClassVar[str]
    reads: ClassVar[bool] = False

    @abstractmethod
    def data(self, x: Scale, y: Scale) -> str:
        """The path's data between two scales."""

    def svg(self, x: Scale, y: Scale) -> Markup:
        """The mark as elements of SVG."""
        named = Markup(' data-name="{}"').format(self.name) if self.reads else ""
        return PATH.format(self.kind, self.ink, named, self.data(x, y))


@final
@dataclass(frozen=True)
class Line(Mark):
    """A line through points, or steps that hold each value until the next point."""

    name: str
    ink: str
    x: FloatArray = field(repr=False)
    y: FloatArray = field(repr=False)
    steps: bool = False
    kind: ClassVar[str] = "line"
    reads: ClassVar[bool] = True

    def data(self, x: Scale, y: Scale) -> str:
        across, up = x.places(self.x), y.places(self.y)
        if self.steps and len(across):
            across, up = np.repeat(across, 2)[1:], np.repeat(up, 2)[:-1]
        return path.line(across, up)


@final
@dataclass(frozen=True)
class Dots(Mark):
    """A dot at each point."""

    name: str
    ink: str
    x: FloatArray = field(repr=False)
    y: FloatArray = field(repr=False)
    kind: ClassVar[str] = "dots"
    reads: ClassVar[bool] = True

    def data(self, x: Scale, y: Scale) -> str:
        return path.dots(x.places(self.x), y.places(self.y))


@final
@dataclass(frozen=True)
class ErrorBars(Mark):
    """A vertical line from a lower to an upper value at each x."""

    name: str
    ink: str
    x: FloatArray = field(repr=False)
    low: FloatArray = field(repr=False)
    high: FloatArray = field(repr=False)
    kind: ClassVar[str] = "bar-line"

    def data(self, x: Scale, y: Scale) -> str:
        at = np.repeat(x.places(self.x), 3)
        ends = np.column_stack(
            [y.places(self.low), y.places(self.high), np.full(len(self.x), np.nan)]
        )
        return path.line(at, ends.ravel())


@final
@dataclass(frozen=True)
class Band(Mark):
    """The area between two curves."""

    name: str
    ink: str
    x: FloatArray = field(repr=False)
    low: FloatArray = field(repr=False)
    high: FloatArray = field(repr=False)
    kind: ClassVar[str] = "band"

    def data(self, x: Scale, y: Scale) -> str:
        return path.outline(x.places(self.x), y.places(self.low), y.places(self.high))


@final
@dataclass(frozen=True)
class Bars(Mark):
    """A bar between each two edges, from the lower end of the plot or from 0 up to its height."""

    name: str
    ink: str
    edges: FloatArray = field(repr=False)
    heights: FloatArray = field(repr=False)
    kind: ClassVar[str] = "bars"

    def data(self, x: Scale, y: Scale) -> str:
        ends, tops = x.places(self.edges), y.places(self.heights)
        floor = max(0.0, float(y.places(np.zeros(1))[0])) if not y.log else 0.0
        some = np.flatnonzero(np.isfinite(tops) & (tops != floor))
        return path.boxes((ends[i], ends[i + 1], floor, tops[i]) for i in some.tolist())


@final
@dataclass(frozen=True)
class Rules(Mark):
    """Straight lines across the plot: upright ones at values of x, level ones at values of y."""

    name: str
    ink: str
    x: Sequence[float] = ()
    y: Sequence[float] = ()
    kind: ClassVar[str] = "rule"

    def data(self, x: Scale, y: Scale) -> str:
        upright = x.places(np.array(self.x, float))
        level = UNITS - y.places(np.array(self.y, float))
        found = [f"M{round(v)} 0V{UNITS}" for v in upright.tolist() if 0 <= v <= UNITS]
        found += [f"M0 {round(v)}H{UNITS}" for v in level.tolist() if 0 <= v <= UNITS]
        return "".join(found)


@final
@dataclass(frozen=True)
class Cells(Mark):
    """Rows of cells between the same edges, the darker the nearer their share is to 1.

    Attributes
    ----------
    edges : (n + 1,)
    shares : (rows, n)
        From 0 to 1; row i stands around y = i.
    """

    name: str
    ink: str
    edges: FloatArray = field(repr=False)
    shares: FloatArray = field(repr=False)
    kind: ClassVar[str] = "cells"

    def data(self, x: Scale, y: Scale) -> str:
        return "".join(self._boxes(x, y, level) for level in range(1, LEVELS + 1))

    def svg(self, x: Scale, y: Scale) -> Markup:
        levels = range(1, LEVELS + 1)
        return Markup("").join(
            PATH.format(self.kind, f"{self.ink} level-{n}", "", self._boxes(x, y, n))
            for n in levels
        )

    def _boxes(self, x: Scale, y: Scale, level: int) -> str:
        """Cells of one shade; neighbours in a row are one box."""
        ends = x.places(self.edges)
        found = []
        for row, shares in enumerate(np.rint(self.shares * LEVELS).astype(int)):
            low, high = y.places(np.array([row - 0.42, row + 0.42]))
            bounds = np.flatnonzero(np.diff(np.concatenate([[0], shares == level, [0]])))
            found += [(ends[a], ends[b], low, high) for a, b in bounds.reshape(-1, 2).tolist()]
        return path.boxes(found)
