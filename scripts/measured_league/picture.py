"""A picture of a case as SVG: a held-out record, measured and simulated, and the errors below."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH, HEIGHT, LEFT, RIGHT = 860, 460, 80, 840
MOST_SAMPLES = 400
"""Of a long record the samples around the largest error of the base model are drawn."""
CURVES = {"base": "base model", "loop": "closed loop", "textbook": "textbook"}
STYLE = """
text { font: 14px system-ui, sans-serif; fill: var(--ink); }
.small { font-size: 12px; }
svg { --ink: #24292f; --page: #ffffff; --rule: #d0d7de;
  --base: #c2410c; --loop: #0969da; --textbook: #1a7f37; }
@media (prefers-color-scheme: dark) {
  svg { --ink: #e6edf3; --page: #0d1117; --rule: #3d444d;
    --base: #ff9d57; --loop: #58a6ff; --textbook: #56d364; }
}
path { fill: none; stroke-width: 1.6; }
.page { fill: var(--page); }
.rule { stroke: var(--rule); stroke-width: 1; }
.measured { stroke: var(--ink); stroke-width: 3.4; stroke-linecap: round; }
.base { stroke: var(--base); }
.loop { stroke: var(--loop); }
.textbook { stroke: var(--textbook); stroke-dasharray: 6 3; }
"""


@dataclass(frozen=True)
class Record:
    """A stretch of one output of one experiment: (n,) times, measured, and simulated by name."""

    experiment: str
    output: str
    times: Array
    measured: Array
    simulated: Mapping[str, Array]


@dataclass(frozen=True)
class Panel:
    """A rectangle with its axes: pixels from above, values at its bottom and top, and times."""

    top: float
    bottom: float
    low: float
    high: float
    start: float
    stop: float

    def points(self, times: Array, values: Array) -> list[str]:
        """Where values stand, as `x y`."""
        x = LEFT + (RIGHT - LEFT) * (times - self.start) / (self.stop - self.start)
        y = self.bottom + (self.top - self.bottom) * (values - self.low) / (self.high - self.low)
        return [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)]

    def curve(self, times: Array, values: Array, kind: str) -> str:
        """A line through all values."""
        return f'<path class="{kind}" d="M{"L".join(self.points(times, values))}"/>'

    def dots(self, times: Array, values: Array) -> str:
        """A dot at each value."""
        dots = "".join(f"M{point}h0" for point in self.points(times, values))
        return f'<path class="measured" d="{dots}"/>'

    def grid(self) -> list[str]:
        """Lines at round values, which stand at the left."""
        parts = []
        for tick in round_values(self.low, self.high):
            (point,) = self.points(np.array([self.start]), np.array([tick]))
            y = float(point.split()[1])
            parts.append(f'<path class="rule" d="M{LEFT} {y}H{RIGHT}"/>')
            parts.append(
                f'<text class="small" x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">'
                f"{tick:.6g}</text>"
            )
        return parts


def held_out_record(runs: Mapping[str, Path]) -> Record:
    """Read what is drawn: the held-out output that the base model misses most.

    Parameters
    ----------
    runs
        Run folders by the names of `CURVES`, "base" among them.
    """
    rows = pq.read_table(runs["base"] / "errors.parquet").to_pylist()
    worst = max(
        (row for row in rows if row["role"] == "test"),
        key=lambda row: row["samples"] * row["rmse_after"] ** 2,
    )
    at = (worst["experiment"], worst["output"])
    times, measured, _ = _columns(runs["base"], *at)
    simulated = {name: _columns(folder, *at)[2] for name, folder in runs.items()}
    part = stretch(np.abs(measured - simulated["base"]))
    cut = {name: values[part] for name, values in simulated.items()}
    return Record(*at, times[part], measured[part], cut)


def stretch(errors: Array) -> slice:
    """Where the largest error is, with half of `MOST_SAMPLES` on each side as far as there are."""
    middle, half = int(np.argmax(errors)), MOST_SAMPLES // 2
    first = max(0, min(middle - half, len(errors) - MOST_SAMPLES))
    return slice(first, first + MOST_SAMPLES)


def round_values(low: float, high: float) -> list[float]:
    """Two to five multiples of 1, 2 or 5 times a power of ten between two numbers."""
    step = 10.0 ** math.floor(math.log10((high - low) / 2.0))
    step *= max(each for each in (1.0, 2.0, 5.0) if each * step <= (high - low) / 2.0)
    first, last = math.ceil(low / step), math.floor(high / step)
    return [step * i for i in range(first, last + 1)]


def picture(record: Record, title: str, unit: str) -> str:
    """Draw a record.

    Parameters
    ----------
    record
        What is drawn.
    title
        What was measured.
    unit
        Of the output.

    Returns
    -------
    str
        A whole SVG file, with colours for a light and for a dark page.
    """
    times = record.times
    errors = {name: record.measured - each for name, each in record.simulated.items()}
    upper = _panel(70, 270, times, [record.measured, *record.simulated.values()])
    lower = _panel(320, 420, times, list(errors.values()))
    drawn = [name for name in CURVES if name in record.simulated]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" role="img">',
        f"<title>{_escaped(title)}</title>",
        f"<style>{STYLE}</style>",
        f'<rect class="page" width="{WIDTH}" height="{HEIGHT}" rx="6"/>',
        f'<text x="{LEFT}" y="24">{_escaped(record.output)} in {_escaped(unit)}, '
        f"held out: {_escaped(record.experiment)}</text>",
        *_legend(drawn),
        *upper.grid(),
        upper.dots(times, record.measured),
        *(upper.curve(times, record.simulated[name], name) for name in drawn),
        f'<text x="{LEFT}" y="304">measured - simulated in {_escaped(unit)}</text>',
        *lower.grid(),
        *(lower.curve(times, errors[name], name) for name in drawn),
        f'<text class="small" x="{LEFT}" y="446">{times[0]:.6g} s</text>',
        f'<text class="small" x="{RIGHT}" y="446" text-anchor="end">{times[-1]:.6g} s</text>',
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _columns(run: Path, experiment: str, output: str) -> tuple[Array, Array, Array]:
    """(times, measured, simulated) of an output of an experiment."""
    filters = [("experiment", "=", experiment), ("output", "=", output)]
    table = pq.read_table(run / "residuals.parquet", filters=filters)
    times, measured, simulated = (
        table[name].to_numpy() for name in ("time", "measured", "simulated")
    )
    return times, measured, simulated


def _panel(top: float, bottom: float, times: Array, curves: Sequence[Array]) -> Panel:
    low, high = min(c.min() for c in curves), max(c.max() for c in curves)
    spare = 0.05 * (high - low) or 1.0
    return Panel(top, bottom, low - spare, high + spare, times[0], times[-1])


def _legend(drawn: Sequence[str]) -> list[str]:
    parts = [f'<path class="measured" d="M{LEFT} 45h0m8 0h0m8 0h0"/>']
    parts.append(f'<text x="{LEFT + 26}" y="50">measured</text>')
    for i, name in enumerate(drawn):
        at = LEFT + 130 + 150 * i
        parts.append(f'<path class="{name}" d="M{at} 45h22"/>')
        parts.append(f'<text x="{at + 28}" y="50">{CURVES[name]}</text>')
    return parts


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
