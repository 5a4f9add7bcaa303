"""Draw the picture of the page on the methods: the cost over what each has simulated.

    for m in least_squares pattern_search cmaes de; do
        cluster-est fit configs/mass_spring_damper.toml --out runs/$m method.name=$m
    done
    cluster-est fit configs/mass_spring_damper.toml --out runs/nelder_mead \\
        method.name=nelder_mead method.options.bounds=enforce
    python scripts/docs/method_picture.py runs/least_squares runs/pattern_search runs/cmaes \\
        runs/de runs/nelder_mead

Writes cluster_est/docs/method_costs.svg from the searches of those runs. The file has colours for a
light and for a dark page.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from workers.messages import FloatArray

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "cluster_est" / "docs" / "method_costs.svg"
WIDTH, HEIGHT = 860, 400
LEFT, RIGHT, TOP, BOTTOM = 70, 700, 60, 340
MOST, LEAST = 3.0, -4.0
"""Powers of ten of the cost above the lowest, over the lowest."""

STYLE = """
text { font: 14px system-ui, sans-serif; fill: var(--ink); }
.small { font-size: 12px; }
svg { --ink: #24292f; --page: #ffffff; --rule: #d0d7de;
  --c0: #0969da; --c1: #c2410c; --c2: #1a7f37; --c3: #8250df; --c4: #9a6700; }
@media (prefers-color-scheme: dark) {
  svg { --ink: #e6edf3; --page: #0d1117; --rule: #3d444d;
    --c0: #58a6ff; --c1: #ff9d57; --c2: #3fb950; --c3: #bc8cff; --c4: #d29922; }
}
.page { fill: var(--page); }
.rule { stroke: var(--rule); fill: none; }
.line { stroke-width: 2; fill: none; stroke-linejoin: round; }
"""


@dataclass(frozen=True)
class Descent:
    """The best cost of a method after so many points, each simulated in every experiment."""

    method: str
    points: FloatArray
    cost: FloatArray


def main() -> None:
    """Read the runs and write the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="folders of fits of one config")
    OUT.write_text(picture([read(run) for run in parser.parse_args().runs]), encoding="utf-8")
    print(OUT.relative_to(ROOT).as_posix(), f"{OUT.stat().st_size / 1e3:.0f} kB")


def read(run: Path) -> Descent:
    """The search of a fit."""
    config = tomllib.loads((run / "config.toml").read_text(encoding="utf-8"))
    table = pq.read_table(run / "searches.parquet")
    table = table.filter(pc.equal(table["search"], "train"))
    cost = np.minimum.accumulate(table["cost"].to_numpy())
    return Descent(config["method"]["name"], table["evaluations"].to_numpy().astype(float), cost)


def picture(descents: Sequence[Descent]) -> str:
    """The descents of several methods as SVG."""
    lowest = min(float(each.cost.min()) for each in descents)
    furthest = np.log10(max(float(each.points.max()) for each in descents))

    def place(points: FloatArray, cost: FloatArray) -> tuple[FloatArray, FloatArray]:
        above = np.log10(np.maximum(cost / lowest - 1.0, 10.0**LEAST))
        x = LEFT + (RIGHT - LEFT) * np.log10(points) / furthest
        return x, TOP + (BOTTOM - TOP) * (MOST - above) / (MOST - LEAST)

    parts = [*_frame(furthest)]
    for number, each in enumerate(sorted(descents, key=lambda d: d.points[-1])):
        x, y = place(each.points, each.cost)
        reached = int(np.argmax(y >= BOTTOM - 1e-6)) if y[-1] >= BOTTOM - 1e-6 else len(y) - 1
        line = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x[: reached + 1], y, strict=False))
        colour = f"var(--c{number})"
        parts.append(f'<path class="line" style="stroke:{colour}" d="M{line}"/>')
        label = f"{each.method}: {each.points[reached]:.0f}"
        at = TOP + 22 * number
        parts.append(f'<path class="line" style="stroke:{colour}" d="M{RIGHT + 6} {at - 5}h16"/>')
        parts.append(f'<text class="small" x="{RIGHT + 26}" y="{at}">{label}</text>')
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" role="img">'
        "<title>The cost over the simulations of five methods</title>"
    )
    page = f'<rect class="page" width="{WIDTH}" height="{HEIGHT}" rx="6"/>'
    return "\n".join([head, f"<style>{STYLE}</style>", page, *parts, "</svg>"]) + "\n"


def _frame(furthest: float) -> list[str]:
    """The axes, with their numbers and names."""
    parts = [
        f'<text x="{LEFT}" y="28">cost above the lowest, over the lowest</text>',
        f'<text class="small" x="{RIGHT}" y="{HEIGHT - 14}" text-anchor="end">'
        "points, each simulated in every experiment</text>",
        f'<text class="small" x="{RIGHT + 6}" y="28">points until 0.0001</text>',
    ]
    for power in range(int(LEAST), int(MOST) + 1):
        y = TOP + (BOTTOM - TOP) * (MOST - power) / (MOST - LEAST)
        parts.append(f'<path class="rule" d="M{LEFT} {y:.1f}H{RIGHT}"/>')
        number = f"{10.0**power:g}"
        parts.append(
            f'<text class="small" x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{number}</text>'
        )
    for power in range(int(furthest) + 1):
        x = LEFT + (RIGHT - LEFT) * power / furthest
        parts.append(
            f'<text class="small" x="{x:.1f}" y="{BOTTOM + 20}" text-anchor="middle">'
            f"{10**power}</text>"
        )
    return parts


if __name__ == "__main__":
    main()
