"""What the pictures share: colours for a light and a dark page, text, axes, measured records."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from workers.messages import FloatArray

Anchor = Literal["start", "middle", "end"]

STYLE = """
text { font: 14px system-ui, sans-serif; fill: var(--ink); }
.head { font-weight: 600; }
.small { font-size: 12px; }
svg { --ink: #24292f; --page: #ffffff; --rule: #d0d7de; --edge: #8c959f; --fill: #f6f8fa;
  --allowed: #dafbe1; --c0: #0969da; --c1: #c2410c; --c2: #1a7f37; --c3: #8250df; --c4: #9a6700; }
@media (prefers-color-scheme: dark) {
  svg { --ink: #e6edf3; --page: #0d1117; --rule: #3d444d; --edge: #6e7681; --fill: #161b22;
    --allowed: #12361f; --c0: #58a6ff; --c1: #ff9d57; --c2: #3fb950; --c3: #bc8cff; --c4: #d29922; }
}
.page { fill: var(--page); }
.rule { stroke: var(--rule); fill: none; }
.line { stroke-width: 2; fill: none; stroke-linejoin: round; }
.c0 { stroke: var(--c0); }
.c1 { stroke: var(--c1); }
.c2 { stroke: var(--c2); }
.c3 { stroke: var(--c3); }
.c4 { stroke: var(--c4); }
"""


def document(size: tuple[int, int], title: str, style: str, parts: Iterable[str]) -> str:
    """An SVG of a width and a height in pixels; `style` is added to the common one."""
    width, height = size
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img">',
        f"<title>{title}</title>",
        f"<style>{STYLE}{style}</style>",
        f'<rect class="page" width="{width}" height="{height}" rx="6"/>',
        *parts,
        "</svg>\n",
    ])  # fmt: skip


def text(x: float, y: float, words: str, kind: str = "small", anchor: Anchor = "start") -> str:
    """A line of text whose baseline is at y."""
    ends = "" if anchor == "start" else f' text-anchor="{anchor}"'
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}"{ends}>{words}</text>'


def lines(x: float, y: float, words: Sequence[str], anchor: Anchor = "start") -> list[str]:
    """Small lines of text, one below the other."""
    return [text(x, y + 16.0 * i, line, anchor=anchor) for i, line in enumerate(words)]


@dataclass(frozen=True)
class Axes:
    """A rectangle of a picture, and the numbers at its edges.

    Attributes
    ----------
    left, right, top, bottom
        In pixels, from the left and from above.
    x, y
        The numbers at left and right, at bottom and top.
    """

    left: float
    right: float
    top: float
    bottom: float
    x: tuple[float, float]
    y: tuple[float, float]

    def across(self, x: float) -> float:
        """Where a number of the horizontal axis is, in pixels."""
        return self.left + (self.right - self.left) * (x - self.x[0]) / (self.x[1] - self.x[0])

    def down(self, y: float) -> float:
        """Where a number of the vertical axis is, in pixels."""
        return self.bottom + (self.top - self.bottom) * (y - self.y[0]) / (self.y[1] - self.y[0])

    def points(self, x: FloatArray, y: FloatArray) -> list[str]:
        """Places in the picture as `x y`; those outside of the vertical axis are at its edge."""
        inside = np.clip(y, *self.y)
        return [f"{self.across(a):.1f} {self.down(b):.1f}" for a, b in zip(x, inside, strict=True)]

    def curve(self, x: FloatArray, y: FloatArray, kind: str) -> str:
        """A line through all points."""
        return f'<path class="{kind}" d="M{"L".join(self.points(x, y))}"/>'

    def area(self, x: FloatArray, low: FloatArray, high: FloatArray, kind: str) -> str:
        """What lies between two curves."""
        edge = [*self.points(x, low), *self.points(x, high)[::-1]]
        return f'<path class="{kind}" d="M{"L".join(edge)}z"/>'

    def dots(self, x: FloatArray, y: FloatArray, kind: str) -> str:
        """A dot at each point, as a stroke without length."""
        return f'<path class="{kind}" d="{"".join(f"M{p}h0" for p in self.points(x, y))}"/>'

    def stairs(self, x: FloatArray, y: FloatArray, kind: str) -> str:
        """A line that keeps each value until the next."""
        return self.curve(np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1], kind)

    def rules(
        self, ticks: Iterable[float], shown: Callable[[float], str] = "{:g}".format
    ) -> list[str]:
        """Horizontal lines with their numbers at the left."""
        found = []
        for tick in ticks:
            y = self.down(tick)
            found.append(f'<path class="rule" d="M{self.left} {y:.1f}H{self.right}"/>')
            found.append(text(self.left - 8, y + 4, shown(tick), anchor="end"))
        return found

    def numbers(
        self, ticks: Iterable[float], shown: Callable[[float], str] = "{:g}".format
    ) -> list[str]:
        """Numbers below the horizontal axis."""
        return [
            text(self.across(tick), self.bottom + 18, shown(tick), anchor="middle")
            for tick in ticks
        ]


RECORD_STYLE = """
.measured { stroke: var(--ink); stroke-width: 3.4; stroke-linecap: round; fill: none; }
.thin { stroke-width: 1.6; fill: none; }
.dashed { stroke-dasharray: 6 3; }
"""


def legend(x: float, y: float, curves: Mapping[str, str], apart: float) -> list[str]:
    """What the curves of a record are: dots are measured, then names by the kind of a curve."""
    parts = [f'<path class="measured" d="M{x} {y - 5}h0m8 0h0m8 0h0"/>']
    parts.append(text(x + 26, y, "measured", "plain"))
    for number, (kind, name) in enumerate(curves.items()):
        at = x + 112 + apart * number
        parts.append(f'<path class="{kind}" d="M{at} {y - 5}h22"/>')
        parts.append(text(at + 28, y, name, "plain"))
    return parts


def record(
    upper: Axes,
    lower: Axes,
    times: FloatArray,
    measured: FloatArray,
    curves: Mapping[str, FloatArray],
) -> list[str]:
    """What was measured with the curves through it, and below what each of them leaves of it."""
    return [
        upper.dots(times, measured, "measured"),
        *(upper.curve(times, values, kind) for kind, values in curves.items()),
        *(lower.curve(times, measured - values, kind) for kind, values in curves.items()),
    ]
