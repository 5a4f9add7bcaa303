"""Charts as HTML with inline SVG, drawn without a library and without a network.

A `Chart` contains plots below each other with a common horizontal scale. A `Plot` contains marks
between two scales. Each mark produces paths; its CSS class determines colours and widths. Texts are
HTML beside a stretched SVG, so their size is the same on any screen and on paper. The page's script
reads scales and paths to show values and to zoom; without the script, everything is still visible.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, final

import numpy as np
from markupsafe import Markup

from cluster_est.html_report.scales import PLOT_UNITS, Scale
from workers.messages import FloatArray, IntArray

LARGEST_COORDINATE = 100 * PLOT_UNITS
"""Larger coordinates are cut off, because a browser draws them in single precision."""


def whole_places(x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return integer coordinates of points, with y upwards, and the indices of these points."""
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    across = np.clip(np.rint(x[known]), -LARGEST_COORDINATE, LARGEST_COORDINATE).astype(np.int64)
    down = np.clip(np.rint(PLOT_UNITS - y[known]), -LARGEST_COORDINATE, LARGEST_COORDINATE).astype(
        np.int64
    )
    return across, down, known


def line_path(x: FloatArray, y: FloatArray) -> str:
    """Return a line through points, which is interrupted at NaN."""
    across, down, known = whole_places(x, y)
    parts = []
    breaks = np.flatnonzero(np.diff(known) > 1) + 1
    for part_x, part_y in zip(np.split(across, breaks), np.split(down, breaks), strict=True):
        if len(part_x):
            steps = np.column_stack([np.diff(part_x), np.diff(part_y)])
            moved = steps[(steps != 0).any(axis=1)]
            rest = _joined(moved.ravel().tolist()) if len(moved) else "0 0"
            parts.append(f"M{part_x[0]} {part_y[0]}l{rest}")
    return "".join(parts)


def dots_path(x: FloatArray, y: FloatArray) -> str:
    """Return a line of length 0 at each point; round ends make it a dot."""
    across, down, _ = whole_places(x, y)
    return "".join(f"M{a} {b}h0" for a, b in zip(across.tolist(), down.tolist(), strict=True))


def outline_path(x: FloatArray, low: FloatArray, high: FloatArray) -> str:
    """Return an area between two lines with the same x."""
    return line_path(np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])) + "z"


def box_paths(corners: Iterable[Sequence[float]]) -> str:
    """Return rectangles, each given by its left, right, lower and upper coordinate."""
    parts = []
    for left, right, low, high in corners:
        a, b = round(left), round(right)
        top, bottom = round(PLOT_UNITS - high), round(PLOT_UNITS - low)
        parts.append(f"M{a} {top}H{b}V{bottom}H{a}z")
    return "".join(parts)


def _joined(numbers: Iterable[int]) -> str:
    """Join numbers, with a space unless a sign separates them."""
    return " ".join(map(str, numbers)).replace(" -", "-")


PATH = Markup('<path class="{} {}"{} d="{}"/>')
SHADES_OF_CELLS = 5
"""Number of shades of `Cells`."""


@dataclass(frozen=True)
class Mark(ABC):
    """A mark in a plot: its values, its ink (a CSS class that names a colour), and its paths.

    `kind` is the CSS class of its paths. Values of marks with `read` are shown under the pointer.
    """

    name: str
    ink: str
    kind: ClassVar[str]
    reads: ClassVar[bool] = False

    @abstractmethod
    def data(self, x: Scale, y: Scale) -> str:
        """Return the path's data between two scales."""

    def svg(self, x: Scale, y: Scale) -> Markup:
        """Return the mark as elements of SVG."""
        named = Markup(' data-name="{}"').format(self.name) if self.reads else ""
        return PATH.format(self.kind, self.ink, named, self.data(x, y))


@final
@dataclass(frozen=True)
class Line(Mark):
    """A line through points, or steps that hold each value until the next point."""

    x: FloatArray = field(repr=False)
    y: FloatArray = field(repr=False)
    steps: bool = False
    kind: ClassVar[str] = "line"
    reads: ClassVar[bool] = True

    def data(self, x: Scale, y: Scale) -> str:
        across, up = x.places(self.x), y.places(self.y)
        if self.steps and len(across):
            across, up = np.repeat(across, 2)[1:], np.repeat(up, 2)[:-1]
        return line_path(across, up)


@final
@dataclass(frozen=True)
class Dots(Mark):
    """A dot at each point."""

    x: FloatArray = field(repr=False)
    y: FloatArray = field(repr=False)
    kind: ClassVar[str] = "dots"
    reads: ClassVar[bool] = True

    def data(self, x: Scale, y: Scale) -> str:
        return dots_path(x.places(self.x), y.places(self.y))


@final
@dataclass(frozen=True)
class ErrorBars(Mark):
    """A vertical line from a lower to an upper value at each x."""

    x: FloatArray = field(repr=False)
    low: FloatArray = field(repr=False)
    high: FloatArray = field(repr=False)
    kind: ClassVar[str] = "bar-line"

    def data(self, x: Scale, y: Scale) -> str:
        at = np.repeat(x.places(self.x), 3)
        ends = np.column_stack(
            [y.places(self.low), y.places(self.high), np.full(len(self.x), np.nan)]
        )
        return line_path(at, ends.ravel())


@final
@dataclass(frozen=True)
class Band(Mark):
    """The area between two curves."""

    x: FloatArray = field(repr=False)
    low: FloatArray = field(repr=False)
    high: FloatArray = field(repr=False)
    kind: ClassVar[str] = "band"

    def data(self, x: Scale, y: Scale) -> str:
        return outline_path(x.places(self.x), y.places(self.low), y.places(self.high))


@final
@dataclass(frozen=True)
class Bars(Mark):
    """A bar between each two edges, from the lower end of the plot or from 0 to its height."""

    edges: FloatArray = field(repr=False)
    heights: FloatArray = field(repr=False)
    kind: ClassVar[str] = "bars"

    def data(self, x: Scale, y: Scale) -> str:
        ends, tops = x.places(self.edges), y.places(self.heights)
        floor = max(0.0, float(y.places(np.zeros(1))[0])) if not y.log else 0.0
        some = np.flatnonzero(np.isfinite(tops) & (tops != floor))
        return box_paths((ends[i], ends[i + 1], floor, tops[i]) for i in some.tolist())


@final
@dataclass(frozen=True)
class Rules(Mark):
    """Straight lines across the plot: vertical at values of x, horizontal at values of y."""

    x: Sequence[float] = ()
    y: Sequence[float] = ()
    kind: ClassVar[str] = "rule"

    def data(self, x: Scale, y: Scale) -> str:
        upright = x.places(np.array(self.x, float))
        level = PLOT_UNITS - y.places(np.array(self.y, float))
        found = [f"M{round(v)} 0V{PLOT_UNITS}" for v in upright.tolist() if 0 <= v <= PLOT_UNITS]
        found += [f"M0 {round(v)}H{PLOT_UNITS}" for v in level.tolist() if 0 <= v <= PLOT_UNITS]
        return "".join(found)


@final
@dataclass(frozen=True)
class Cells(Mark):
    """Rows of cells between the same edges, which are darker for a larger share.

    Attributes
    ----------
    edges : (n + 1,)
    shares : (rows, n)
        From 0 to 1; row i is centred at y = i.
    """

    edges: FloatArray = field(repr=False)
    shares: FloatArray = field(repr=False)
    kind: ClassVar[str] = "cells"

    def data(self, x: Scale, y: Scale) -> str:
        return "".join(self._boxes(x, y, level) for level in range(1, SHADES_OF_CELLS + 1))

    def svg(self, x: Scale, y: Scale) -> Markup:
        levels = range(1, SHADES_OF_CELLS + 1)
        return Markup("").join(
            PATH.format(self.kind, f"{self.ink} level-{n}", "", self._boxes(x, y, n))
            for n in levels
        )

    def _boxes(self, x: Scale, y: Scale, level: int) -> str:
        """Return the cells of one shade; adjacent cells in a row are one box."""
        ends = x.places(self.edges)
        found = []
        for row, shares in enumerate(np.rint(self.shares * SHADES_OF_CELLS).astype(int)):
            low, high = y.places(np.array([row - 0.42, row + 0.42]))
            bounds = np.flatnonzero(np.diff(np.concatenate([[0], shares == level, [0]])))
            found += [(ends[a], ends[b], low, high) for a, b in bounds.reshape(-1, 2).tolist()]
        return box_paths(found)


PIXELS_A_TICK, PIXELS_A_TEXT = 40, 17
"""Height in pixels of a plot for each tick: usual and smallest."""
MOST_SIGNS = 70
"""Largest number of characters below a plot, including two for the space after each number."""

PLOT = Markup(
    '<div class="plot" style="height:{height}px" data-x="{x}" data-y="{y}"{called}>{label}{beside}'
    '<svg viewBox="0 0 {units} {units}" preserveAspectRatio="none" role="img" aria-label="{title}">'
    '<title>{title}</title><path class="grid" d="{grid}"/>{marks}</svg>{below}</div>'
)
CHART = Markup('<div class="chart{classes}"{gutter}{record}>{legend}{plots}{under}</div>')
USUAL_GUTTER = 56
"""Usual width of the numbers at the left of a plot, in pixels."""


@final
@dataclass(frozen=True)
class Plot:
    """A rectangle with marks between two scales.

    Attributes
    ----------
    title
        Description of the content, for screen readers.
    label
        Label above its vertical scale.
    x, y
        Its scales.
    marks
        Marks; the last one is drawn on top.
    height
        Height in pixels.
    rows
        Names of the rows at y = 0, 1, ...; without names, ticks at round values of y.
    called
        Name of its values under the pointer and in a file, if the names of the marks have another
        meaning in the chart's other plots.
    """

    title: str
    label: str
    x: Scale
    y: Scale
    marks: Sequence[Mark] = field(repr=False)
    height: int = 220
    rows: Sequence[str] = ()
    called: str = ""

    def beside(self) -> tuple[tuple[float, str], ...]:
        """Values of y and their labels."""
        if self.rows:
            return tuple((float(i), name) for i, name in enumerate(self.rows))
        ticks = self.y.ticks(max(2, round(self.height / PIXELS_A_TICK)))
        return ticks[:: math.ceil(len(ticks) * PIXELS_A_TEXT / self.height)]

    def under(self, most: int) -> tuple[tuple[float, str], ...]:
        """Return values of x and their labels, as many as fit."""
        ticks = self.x.ticks(most)
        while most > 1 and sum(len(text) + 2 for _, text in ticks) > MOST_SIGNS:
            most -= 1
            ticks = self.x.ticks(most)
        return ticks

    def html(self, *, across: int, last: bool) -> Markup:
        """Return the plot as HTML; labels of x are only below the `last` plot of a chart."""
        up = [(place, text) for place, text in self._placed(self.y, self.beside())]
        right = self._placed(self.x, self.under(across))
        grid = [f"M0 {round(PLOT_UNITS - place)}H{PLOT_UNITS}" for place, _ in up if not self.rows]
        grid += [f"M{round(place)} 0V{PLOT_UNITS}" for place, _ in right]
        return PLOT.format(
            height=self.height,
            x=_ends(self.x),
            y=_ends(self.y) if not self.rows else "",
            called=Markup(' data-called="{}"').format(self.called) if self.called else "",
            label=Markup('<p class="label">{}</p>').format(self.label) if self.label else "",
            beside=_texts("y-axis", "bottom", up),
            title=self.title,
            units=PLOT_UNITS,
            grid="".join(grid),
            marks=Markup("").join(mark.svg(self.x, self.y) for mark in self.marks),
            below=_texts("x-axis", "left", right) if last else "",
        )

    @staticmethod
    def _placed(scale: Scale, ticks: Sequence[tuple[float, str]]) -> list[tuple[float, str]]:
        at = scale.places(np.array([value for value, _ in ticks], float))
        return [(p, text) for p, (_, text) in zip(at.tolist(), ticks, strict=True)]


@final
@dataclass(frozen=True)
class Chart:
    """Plots below each other.

    Attributes
    ----------
    plots
        Plots with the same horizontal scale.
    below
        Label of the horizontal scale.
    legend
        Whether the names of the marks are shown.
    across
        Approximate number of labels of the horizontal scale.
    gutter
        Width in pixels of the labels at the left; None for numbers.
    zooms
        Whether values are shown under the pointer, and dragging zooms.
    record
        Name of the `FullRecord` with all samples of the chart; "" if there is none.
    """

    plots: Sequence[Plot]
    below: str = ""
    legend: bool = True
    across: int = 8
    gutter: int | None = None
    zooms: bool = True
    record: str = ""

    def html(self) -> Markup:
        """Return the chart as HTML."""
        last = len(self.plots) - 1
        plots = [plot.html(across=self.across, last=i == last) for i, plot in enumerate(self.plots)]
        gutter = self.gutter or max(
            (_gutter([text for _, text in plot.beside()]) for plot in self.plots), default=0
        )
        wide = Markup(' style="--gutter:min({}px,40vw)"').format(gutter)
        return CHART.format(
            classes=" zooms" if self.zooms else "",
            gutter=wide if gutter > USUAL_GUTTER else "",
            record=Markup(' data-record="{}"').format(self.record) if self.record else "",
            legend=self._legend(),
            plots=Markup("").join(plots),
            under=Markup('<p class="below">{}</p>').format(self.below) if self.below else "",
        )

    def _legend(self) -> Markup:
        marks = [mark for plot in self.plots for mark in plot.marks if mark.name]
        if not self.legend or not marks:
            return Markup("")
        named = {mark.name: mark for mark in reversed(marks)}
        entry = Markup('<span><i class="{} {}"></i>{}</span>')
        entries = [entry.format(m.kind, m.ink, m.name) for m in reversed(named.values())]
        return Markup('<p class="legend">{}</p>').format(Markup("").join(entries))


def row_chart(
    title: str, below: str, across: Scale, marks: Sequence[Mark], names: Sequence[str],
    *, height: int = 20, least: int = 60, legend: bool = True, ticks: int = 8,
) -> Chart:  # fmt: skip
    """Return a chart with a row for each name, the first one at the top.

    The height of all rows together is at least `least` pixels.
    """
    upright = Scale(len(names) - 0.5, -0.5)
    plot = Plot(title, "", across, upright, marks, max(least, height * len(names)), names)
    return Chart((plot,), below, legend, ticks, _gutter(names), zooms=False)


def _gutter(names: Sequence[str]) -> int:
    """Return the width in pixels of names at the left of a plot; longer names are cut off."""
    return min(240, 16 + 7 * max(map(len, names), default=0))


def _ends(scale: Scale) -> str:
    """Return both ends with all digits, for the page's script."""
    return f"{scale.low!r} {scale.high!r}{' log' if scale.log else ''}"


def _texts(kind: str, side: str, placed: Sequence[tuple[float, str]]) -> Markup:
    """Return texts at their positions along one side of a plot."""
    entry = Markup('<span style="{}:{}%">{}</span>')
    texts = [entry.format(side, f"{100.0 * at / PLOT_UNITS:.4g}", text) for at, text in placed]
    return Markup('<div class="{}" aria-hidden="true">{}</div>').format(
        kind, Markup("").join(texts)
    )
