"""The section on the search: convergence, starts, profiles, fronts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from cluster_est.report.blocks import (
    Block,
    FigureBlock,
    ReportSection,
    TableBlock,
    TableCell,
    TextBlock,
    axis,
    cells,
    columns,
    plain,
)
from cluster_est.report.encode import short
from cluster_est.report.folder import ReportedRun, Row
from cluster_est.report.numbers import digits

MOST_LINES = 40
"""Searches that are drawn: the best ones."""
AFTERWARDS = ("derivatives", "profile", "bootstrap")
"""How the names of searches begin that look around a solution."""
MOST_POINTS = 3000
SMALL_MULTIPLES = 12
LOG_FROM = 10.0
"""Ratio of the costs beyond which their axis is logarithmic."""


def search(run: ReportedRun) -> ReportSection:
    """Everything about the search that the folder holds."""
    blocks = [*_convergence(run), *_starts(run), *_profiles(run), *_front(run)]
    return ReportSection("search", "How the search went", tuple(blocks))


def _convergence(run: ReportedRun) -> list[Block]:
    searches: dict[str, list[Row]] = {}
    for row in run.tables["searches"]:
        if row["search"].startswith(AFTERWARDS):
            continue
        if row["cost"] is not None and math.isfinite(row["cost"]):
            searches.setdefault(row["search"], []).append(row)
    moving = {name: rows for name, rows in searches.items() if len(rows) > 1}
    searches = moving or searches  # single points are nothing that converges
    if not searches:
        return []
    if any(_begins_again(rows) for rows in searches.values()):
        return _all_searches(run)
    best = {name: min(row["cost"] for row in rows) for name, rows in searches.items()}
    names = sorted(searches, key=lambda name: (best[name], name))[:MOST_LINES]
    lead = next((n for n in ("train", "final", "base", *names) if n in searches), names[0])
    order = [name for name in searches if name in names and name != lead] + [lead]
    traces = [
        {
            "x": [row["evaluations"] for row in searches[name]],
            "y": short(np.array([row["cost"] for row in searches[name]], float)),
            "name": plain(name),
            "mode": "lines+markers" if len(searches[name]) < 60 else "lines",
            "marker": {"size": 4},
            "line": {"width": 2 if name == lead else 1, "shape": "hv"},
            **({"line": {"color": "$after", "width": 2, "shape": "hv"}} if name == lead else {}),
        }
        for name in order
    ]
    costs = [row["cost"] for name in order for row in searches[name]]
    layout = {
        "xaxis": axis("evaluations of the search"),
        "yaxis": _cost_axis(costs),
        "hovermode": "closest",
        "showlegend": 1 < len(order) <= 12,
    }
    shown = "" if len(names) == len(searches) else f", the best {len(names)} of {len(searches)}"
    return [FigureBlock("convergence", f"Cost over evaluations{shown}", traces, layout)]


def _begins_again(rows: Sequence[Row]) -> bool:
    """Return whether several searches have one name, as in a closed loop."""
    return any(later["evaluations"] < row["evaluations"] for row, later in pairwise(rows))


def _all_searches(run: ReportedRun) -> list[Block]:
    """The costs of all searches as points, in their order."""
    rows = [
        (number, row)
        for number, row in enumerate(run.tables["progress"])
        if math.isfinite(row["cost"])
    ]
    rows = rows[:: max(1, len(rows) // MOST_POINTS)]
    traces = [
        {
            "x": [number for number, row in rows if row["search"] == name],
            "y": short(np.array([row["cost"] for _, row in rows if row["search"] == name], float)),
            "name": plain(name),
            "mode": "markers",
            "marker": {"size": 5, "opacity": 0.7},
        }
        for name in dict.fromkeys(row["search"] for _, row in rows)
    ]
    if not traces:
        return [
            TextBlock("The folder does not tell its searches apart, so none is drawn.", "faint")
        ]
    layout = {
        "xaxis": axis("iterations of all searches, in their order"),
        "yaxis": _cost_axis([row["cost"] for _, row in rows]),
        "hovermode": "closest",
        "showlegend": len(traces) <= 12,
    }
    return [FigureBlock("convergence", "Costs of all searches", traces, layout, 360)]


def _cost_axis(costs: Sequence[float], title: str = "cost") -> dict[str, Any]:
    """Logarithmic where the costs span much."""
    low, high = min(costs), max(costs)
    if low > 0.0 and high / low > LOG_FROM:
        return axis(
            title, type="log", exponentformat="power", dtick=1 if high / low > 100 else "D2"
        )
    if high - low < 1e-3 * abs(high):  # nothing but rounding would fill the axis
        return axis(title, range=sorted((0.5 * low, 1.5 * high)))
    return axis(title)


def _starts(run: ReportedRun) -> list[Block]:
    rows = run.tables["starts"]
    if not rows:
        return []
    ended = sorted((r for r in rows if r["cost"] is not None and math.isfinite(r["cost"])),
                   key=lambda r: (r["cost"], r["start"]))  # fmt: skip
    traces = []
    for sign, name, colour in (
        (0, "best minimum", "$after"),
        (1, "other minima", "$before"),
        (-1, "no minimum", "$muted"),
    ):
        own = [(i + 1, r) for i, r in enumerate(ended) if np.sign(r["minimum"]) == sign]
        if own:
            traces.append(
                {
                    "x": [i for i, _ in own],
                    "y": short(np.array([r["cost"] for _, r in own], float)),
                    "text": [f"start {r['start']}, {plain(r['ending'])}" for _, r in own],
                    "hovertemplate": "%{text}: %{y}<extra></extra>",
                    "mode": "markers",
                    "marker": {"color": colour, "size": 7},
                    "name": name,
                }
            )
    blocks: list[Block] = []
    if traces:
        layout = {
            "xaxis": axis("starts, the best first", dtick=max(1, len(ended) // 10)),
            "yaxis": _cost_axis([r["cost"] for r in ended]),
            "hovermode": "closest",
        }
        title = f"Waterfall of {len(rows)} starts"
        blocks.append(FigureBlock("waterfall", title, traces, layout, 280))
    return [*blocks, *_minima(run, rows)]


def _minima(run: ReportedRun, starts: Sequence[Row]) -> list[Block]:
    points = {row["point"]: row["cost"] for row in run.tables["minima"]}
    counts = Counter(row["minimum"] for row in starts)
    labels = list(dict.fromkeys(row["label"] for row in run.tables["minima"]))[:6]
    values = {(row["point"], row["label"]): row["value"] for row in run.tables["minima"]}
    lines = [
        cells(
            str(p),
            digits(cost, 6),
            str(counts[p]),
            *(digits(values.get((p, label))) for label in labels),
        )
        for p, cost in points.items()
    ]
    if counts[-1]:
        lines.append(cells(TableCell("none", "bad"), "", str(counts[-1]), *("" for _ in labels)))
    names = columns("minimum", "#cost", "#starts", *(f"#{label}" for label in labels))
    return [TableBlock(names, tuple(lines), "Minima that were reached")] if lines else []


def _profiles(run: ReportedRun) -> list[Block]:
    rows = [row for row in run.tables["profiles"] if row["unknown"] == row["label"]]
    labels = list(dict.fromkeys(row["label"] for row in rows))
    ends = {r["label"]: r for r in run.tables["intervals"] if r["source"] == "profile"}
    blocks: list[Block] = []
    for number, label in enumerate(labels[:SMALL_MULTIPLES]):
        own = sorted((r for r in rows if r["label"] == label), key=lambda r: r["value"])
        traces = [
            {
                "x": short(np.array([r["value"] for r in own], float)),
                "y": short(np.array([r["cost"] for r in own], float)),
                "mode": "lines+markers",
                "marker": {"size": 4},
                "line": {"color": "$after"},
                "name": "profile",
                "showlegend": False,
            }
        ]
        found = ends.get(label, {"lower": None, "upper": None})
        shapes = [
            {"type": "line", "x0": end, "x1": end, "y0": 0, "y1": 1, "yref": "paper",
             "line": {"color": "$muted", "dash": "dot", "width": 1}}
            for end in (found["lower"], found["upper"])
            if end is not None and math.isfinite(end)
        ]  # fmt: skip
        layout = {"xaxis": axis(label), "yaxis": axis("cost"), "shapes": shapes}
        blocks.append(FigureBlock(f"profile-{number}", f"Profile of {label}", traces, layout, 240))
    if len(labels) > SMALL_MULTIPLES:
        blocks.append(TextBlock(f"{SMALL_MULTIPLES} of {len(labels)} profiles are drawn.", "faint"))
    return blocks


def _front(run: ReportedRun) -> list[Block]:
    points = {row["point"]: row["objectives"] for row in run.tables["front"]}
    if not points or min(map(len, points.values())) < 2:
        return []
    first, second = ([values[i] for values in points.values()] for i in (0, 1))
    trace = {
        "x": short(np.array(first, float)),
        "y": short(np.array(second, float)),
        "text": [f"point {p}" for p in points],
        "mode": "markers",
        "marker": {"color": "$after", "size": 6},
        "name": "front",
    }
    layout = {
        "xaxis": axis("first objective"),
        "yaxis": axis("second objective"),
        "hovermode": "closest",
    }
    return [FigureBlock("front", f"Front of {len(points)} points", [trace], layout)]
