"""Charts: plots below each other, with the same scale across, as HTML with inline SVG.

Texts are HTML beside a stretched SVG, so that they keep their size on any screen and on paper. The
page's script reads scales and paths back to show values and to zoom; all is seen without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from markupsafe import Markup

from cluster_est.report.drawing.marks import Mark
from cluster_est.report.drawing.scale import UNITS, Scale

PIXELS_A_TICK = 40
"""Height of a plot for each value that is written beside it."""
MOST_SIGNS = 70
"""Signs of the numbers below a plot, and two for the space after each: more would run together."""

PLOT = Markup(
    '<div class="plot" style="height:{height}px" data-x="{x}" data-y="{y}">{label}{beside}'
    '<svg viewBox="0 0 {units} {units}" preserveAspectRatio="none" role="img" aria-label="{title}">'
    '<title>{title}</title><path class="grid" d="{grid}"/>{marks}</svg>{below}</div>'
)
CHART = Markup('<div class="chart{classes}"{gutter}>{legend}{plots}{under}</div>')


@final
@dataclass(frozen=True)
class Plot:
    """A rectangle with marks between two scales.

    Attributes
    ----------
    title
        What it shows, in words, for those who do not see it.
    label
        What stands above its upright scale.
    x, y
        Its scales.
    marks
        The last one is drawn on top.
    height
        In pixels.
    rows
        Names of the rows at y = 0, 1, ...; round values of y if there are none.
    """

    title: str
    label: str
    x: Scale
    y: Scale
    marks: Sequence[Mark] = field(repr=False)
    height: int = 220
    rows: Sequence[str] = ()

    def beside(self) -> tuple[tuple[float, str], ...]:
        """Values of y with what is written at them."""
        if self.rows:
            return tuple((float(i), name) for i, name in enumerate(self.rows))
        return self.y.ticks(max(2, round(self.height / PIXELS_A_TICK)))

    def under(self, most: int) -> tuple[tuple[float, str], ...]:
        """Values of x with what is written at them, as many as there is room for."""
        ticks = self.x.ticks(most)
        while most > 1 and sum(len(text) + 2 for _, text in ticks) > MOST_SIGNS:
            most -= 1
            ticks = self.x.ticks(most)
        return ticks

    def html(self, *, across: int, last: bool) -> Markup:
        """The plot as HTML; values of x are written below the `last` one of a chart."""
        up = [(place, text) for place, text in self._placed(self.y, self.beside())]
        right = self._placed(self.x, self.under(across))
        grid = [f"M0 {round(UNITS - place)}H{UNITS}" for place, _ in up if not self.rows]
        grid += [f"M{round(place)} 0V{UNITS}" for place, _ in right]
        return PLOT.format(
            height=self.height,
            x=_ends(self.x),
            y=_ends(self.y) if not self.rows else "",
            label=Markup('<p class="label">{}</p>').format(self.label) if self.label else "",
            beside=_texts("y-axis", "bottom", up),
            title=self.title,
            units=UNITS,
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
        With the same scale across.
    below
        What the scale across shows.
    legend
        Whether the names of the marks are shown.
    across
        About how many values are written across.
    gutter
        Pixels at the left for what is written there; None for numbers.
    zooms
        Whether values are shown under the pointer, and dragging zooms.
    """

    plots: Sequence[Plot]
    below: str = ""
    legend: bool = True
    across: int = 8
    gutter: int | None = None
    zooms: bool = True

    def html(self) -> Markup:
        """The chart as HTML."""
        last = len(self.plots) - 1
        plots = [plot.html(across=self.across, last=i == last) for i, plot in enumerate(self.plots)]
        gutter = (
            Markup(' style="--gutter:min({}px,40vw)"').format(self.gutter) if self.gutter else ""
        )
        return CHART.format(
            classes=" zooms" if self.zooms else "",
            gutter=gutter,
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


def gutter(names: Sequence[str]) -> int:
    """Return pixels that names at the left of a plot take; longer ones are cut off."""
    return min(240, 16 + 7 * max(map(len, names), default=0))


def _ends(scale: Scale) -> str:
    """Both ends with all their digits, for the page's script."""
    return f"{scale.low!r} {scale.high!r}{' log' if scale.log else ''}"


def _texts(kind: str, side: str, placed: Sequence[tuple[float, str]]) -> Markup:
    """Texts at their places along one side of a plot."""
    entry = Markup('<span style="{}:{}%">{}</span>')
    texts = [entry.format(side, f"{100.0 * at / UNITS:.4g}", text) for at, text in placed]
    return Markup('<div class="{}" aria-hidden="true">{}</div>').format(
        kind, Markup("").join(texts)
    )
