"""Draw the picture of the README: a closed loop on data with a friction that nothing declares.

    cluster-est close-loop configs/mass_with_friction.toml --out runs/friction
    python scripts/docs/picture.py runs/friction

Writes cluster_est/docs/closed_loop.svg from the tables of that run: the experiment that was held
out, as measured, by the declared model once it is fitted, and with the effect that was found. The
file has colours for a light and for a dark page.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "cluster_est" / "docs" / "closed_loop.svg"
EXPERIMENT = "exp4"
WIDTH, HEIGHT = 860, 500
LEFT, RIGHT = 70, 840

Array = NDArray[np.float64]

STYLE = """
text { font: 14px system-ui, sans-serif; fill: var(--ink); }
.head { font-weight: 600; font-size: 16px; }
.small { font-size: 12px; }
svg { --ink: #24292f; --page: #ffffff; --rule: #d0d7de; --before: #c2410c; --after: #0969da; }
@media (prefers-color-scheme: dark) {
  svg { --ink: #e6edf3; --page: #0d1117; --rule: #3d444d; --before: #ff9d57; --after: #58a6ff; }
}
.page { fill: var(--page); }
.rule { stroke: var(--rule); fill: none; }
.measured { stroke: var(--ink); stroke-width: 3.4; stroke-linecap: round; fill: none; }
.before { stroke: var(--before); stroke-width: 1.6; fill: none; }
.after { stroke: var(--after); stroke-width: 1.6; fill: none; }
"""


@dataclass(frozen=True)
class Panel:
    """A rectangle of the picture with its axes.

    Attributes
    ----------
    top, bottom
        In pixels, from above.
    low, high
        The values at bottom and top.
    stop
        The time at the right edge; the left one is at 0.
    """

    top: float
    bottom: float
    low: float
    high: float
    stop: float

    def points(self, times: Array, values: Array) -> list[str]:
        """Where values stand in the picture, as `x y`."""
        x = LEFT + (RIGHT - LEFT) * times / self.stop
        y = self.bottom + (self.top - self.bottom) * (values - self.low) / (self.high - self.low)
        return [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)]

    def curve(self, times: Array, values: Array, kind: str) -> str:
        """A line through all values."""
        return f'<path class="{kind}" d="M{"L".join(self.points(times, values))}"/>'

    def dots(self, times: Array, values: Array) -> str:
        """A dot at each value."""
        dots = "".join(f"M{point}h0" for point in self.points(times, values))
        return f'<path class="measured" d="{dots}"/>'

    def grid(self, ticks: Sequence[float], digits: int) -> str:
        """Lines with numbers at the left."""
        parts = []
        for tick in ticks:
            (at,) = self.points(np.zeros(1), np.array([tick]))
            y = float(at.split()[1])
            parts.append(f'<path class="rule" d="M{LEFT} {y}H{RIGHT}"/>')
            parts.append(
                f'<text class="small" x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">'
                f"{tick:.{digits}f}</text>"
            )
        return "\n".join(parts)


def main() -> None:
    """Read the run and write the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of the closed loop")
    run = parser.parse_args().run
    OUT.write_text(picture(run), encoding="utf-8")
    print(OUT.relative_to(ROOT).as_posix(), f"{OUT.stat().st_size / 1e3:.0f} kB")


def picture(run: Path) -> str:
    """The picture of a closed loop as SVG."""
    table = pq.read_table(run / "residuals.parquet")
    table = table.filter(pc.equal(table["experiment"], EXPERIMENT))
    times, measured, after, before = (
        table[name].to_numpy() for name in ("time", "measured", "simulated", "simulated_before")
    )
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    (effect,) = facts["effects"]
    values = ", ".join(
        f"{name} = {value['value']:.4g} {value['unit']}"
        for name, value in effect["parameters"].items()
    )
    upper = Panel(84, 290, -0.6, 0.6, float(times[-1]))
    lower = Panel(356, 456, -0.15, 0.15, float(times[-1]))
    seconds = [
        f'<text class="small" x="{LEFT + (RIGHT - LEFT) * s / times[-1]:.1f}" y="474" '
        f'text-anchor="middle">{s}</text>'
        for s in range(0, int(times[-1]) + 1, 2)
    ]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" role="img">',
        f"<title>Found: {effect['equation']}</title>",
        f"<style>{STYLE}</style>",
        f'<rect class="page" width="{WIDTH}" height="{HEIGHT}" rx="6"/>',
        f'<text class="head" x="{LEFT}" y="28">found: {effect["equation"]}</text>',
        f'<text x="{RIGHT}" y="28" text-anchor="end">{values}</text>',
        f'<text x="{LEFT}" y="58">position in m, held-out experiment</text>',
        *_legend(460, 58),
        upper.grid((-0.5, 0.0, 0.5), 1),
        upper.dots(times, measured),
        upper.curve(times, before, "before"),
        upper.curve(times, after, "after"),
        f'<text x="{LEFT}" y="330">measured - simulated in m; root mean square '
        f"{_rms(measured - before):.4f} before, {_rms(measured - after):.4f} after</text>",
        lower.grid((-0.1, 0.0, 0.1), 1),
        lower.curve(times, measured - before, "before"),
        lower.curve(times, measured - after, "after"),
        *seconds,
        f'<text class="small" x="{RIGHT}" y="492" text-anchor="end">time in s</text>',
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _legend(x: float, y: float) -> list[str]:
    """What the three curves are."""
    parts = [f'<path class="measured" d="M{x} {y - 5}h0m8 0h0m8 0h0"/>']
    parts.append(f'<text x="{x + 26}" y="{y}">measured</text>')
    for kind, name, at in (
        ("before", "fitted model", x + 112),
        ("after", "with the effect", x + 246),
    ):
        parts.append(f'<path class="{kind}" d="M{at} {y - 5}h22"/>')
        parts.append(f'<text x="{at + 28}" y="{y}">{name}</text>')
    return parts


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
