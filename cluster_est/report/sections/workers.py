"""The section on busy times of workers, and on failures."""

from __future__ import annotations

from cluster_est.report.activity import busy_shares, without_breaks
from cluster_est.report.blocks import (
    Block,
    FigureBlock,
    ReportSection,
    SourceBlock,
    TableBlock,
    TableCell,
    TextBlock,
    cells,
    columns,
)
from cluster_est.report.drawing import Cells, Chart, Plot, Scale
from cluster_est.report.drawing.chart import gutter
from cluster_est.report.drawing.time_unit import time_unit
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
    order = sorted(range(len(activity.workers)), key=lambda i: activity.workers[i])[:MOST_WORKERS]
    names = [activity.workers[i] for i in order]
    shown = "" if len(order) == len(activity.workers) else f", {len(order)} of them"
    cut = f"; breaks of {duration(idle)} are cut out" if idle else ""
    title = f"When the workers were busy{shown}{cut}"
    unit = time_unit(float(edges[-1]))
    seconds = edges / unit.seconds
    plot = Plot(
        title,
        "",
        Scale.around(seconds, margin=0.0),
        Scale(len(order) - 0.5, -0.5),
        [Cells("busy", "after", seconds, shares[order])],
        max(22, min(44, 400 // len(order))) * len(order),
        names,
    )
    below = f"{unit.name} since the first simulation began; the darker, the busier"
    chart = Chart((plot,), below, legend=False, gutter=gutter(names), zooms=False)
    return [FigureBlock("time-line", title, chart)]


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


def provenance(run: ReportedRun) -> ReportSection:
    """Model, hashes, seed, versions, data and the resolved config."""
    facts = run.facts
    fmu = facts.get("fmu") or {}
    known = [
        ("FMU", fmu.get("name")),
        ("its SHA-256", fmu.get("sha256")),
        ("interface", str(fmu.get("interface") or "").replace("_", " ")),
        ("solver", fmu.get("solver")),
        ("config hash", facts.get("config_hash")),
        ("seed", facts.get("seed")),
        ("started", facts.get("started")),
        ("format", facts.get("format")),
    ]
    rows = [cells(k, TableCell(str(v), code=True)) for k, v in known if v not in (None, "")]
    blocks: list[Block] = [TableBlock(columns("", ""), tuple(rows))]
    versions = facts.get("versions") or {}
    lines = tuple(cells(k, TableCell(str(v), code=True)) for k, v in sorted(versions.items()))
    if lines:
        blocks.append(TableBlock(columns("software", "version"), lines, "Versions", folded=True))
    experiments = facts.get("experiments") or {}
    lines = tuple(cells(str(k), TableCell(str(v), code=True)) for k, v in experiments.items())
    if lines:
        caption = f"Hashes of the {len(lines)} experiments"
        blocks.append(TableBlock(columns("experiment", "hash"), lines, caption, folded=True))
    if run.config:
        blocks.append(SourceBlock("The config, with every default", run.config))
    return ReportSection("provenance", "Where this comes from", tuple(blocks))
