"""The section on busy times of workers, and on failures."""

from __future__ import annotations

import numpy as np

from cluster_est.report.activity import busy_shares, without_breaks
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
from cluster_est.report.folder import ReportedRun
from cluster_est.report.numbers import count, duration, percent

BINS, MOST_WORKERS = 160, 64


def workers(run: ReportedRun) -> ReportSection:
    """A time line, a table of workers, and failures by their reasons."""
    blocks = [*_failures(run), *_time_line(run), *_table(run)]
    return ReportSection("workers", "Workers and failures", tuple(blocks))


def _failures(run: ReportedRun) -> list[Block]:
    found = run.activity.failures
    if not found:
        return [TextBlock("No simulation failed.")] if run.activity.simulations else []
    names = columns("#times", "status", "reason", "experiments", "#first ID")
    rows = tuple(
        cells(
            count(each.count),
            each.status,
            each.message or "no message",
            TableCell(
                ", ".join(each.experiments[:4]) + (" …" if len(each.experiments) > 4 else "")
            ),
            str(each.first),
        )
        for each in found
    )
    hint = TextBlock("To run one again: cluster-est replay RUN ID.", "faint")
    return [TableBlock(names, rows, "Simulations that failed", folded=len(rows) > 20), hint]


def _time_line(run: ReportedRun) -> list[Block]:
    activity = run.activity
    if not len(activity.ended):
        return []
    activity, idle = without_breaks(activity)
    edges, shares = busy_shares(activity, BINS)
    middles = 0.5 * (edges[1:] + edges[:-1])
    order = sorted(range(len(activity.workers)), key=lambda i: activity.workers[i])[:MOST_WORKERS]
    names = [plain(activity.workers[i]) for i in order]
    trace = {
        "type": "heatmap",
        "x": short(middles),
        "y": list(range(len(order))),
        "z": [short(np.round(shares[i], 3)) for i in order],
        "zmin": 0,
        "zmax": 1,
        "ygap": 2,
        "colorscale": "$sequential",
        "colorbar": {"thickness": 10, "outlinewidth": 0, "tickvals": [0, 0.5, 1],
                     "ticktext": ["idle", "half", "busy"]},
        "hovertemplate": "%{x:.4g} s: busy %{z:.0%}<extra></extra>",
    }  # fmt: skip
    layout = {
        "xaxis": axis("s since the first simulation began", showgrid=False),
        "yaxis": {"tickvals": trace["y"], "ticktext": names, "autorange": "reversed",
                  "showgrid": False, "zeroline": False},
        "hovermode": "closest",
    }  # fmt: skip
    shown = "" if len(order) == len(activity.workers) else f", {len(order)} of them"
    height = 120 + max(22, min(44, 400 // len(order))) * len(order)
    cut = f"; breaks of {duration(idle)} are cut out" if idle else ""
    title = f"When the workers were busy{shown}{cut}"
    return [FigureBlock("time-line", title, [trace], layout, height)]


def _table(run: ReportedRun) -> list[Block]:
    rows = run.tables["workers"]
    if not rows:
        return []
    names = columns("worker", "#simulations", "#failed", "#busy", "#of the time")
    lines = tuple(
        cells(
            TableCell(row["worker"], code=True),
            count(row["simulations"]),
            count(row["failures"]),
            duration(row["busy_seconds"]),
            percent(row["busy_seconds"] / row["seconds"] if row["seconds"] else None),
        )
        for row in rows
    )
    return [TableBlock(names, lines, "Workers", folded=len(lines) > 12)]
