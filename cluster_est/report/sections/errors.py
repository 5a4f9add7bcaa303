"""Errors before and after, by output and experiment."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cluster_est.report.blocks import (
    Block,
    ReportSection,
    TableBlock,
    TableCell,
    TextBlock,
    Tone,
    cells,
    columns,
)
from cluster_est.report.folder import ReportedRun, Row
from cluster_est.report.numbers import count, digits, percent

ROLES = {"train": "training", "test": "held out"}
MOST_OPEN = 24
"""Rows of the table by experiment that are not folded."""


def errors(run: ReportedRun) -> ReportSection:
    """A table by output, and one by output and experiment."""
    rows = run.tables["errors"]
    if not rows:
        return ReportSection("errors", "Errors", ())
    blocks: list[Block] = [
        TextBlock(
            f"Root mean square of measured less simulated. Before: {run.before}. Of the signal: "
            "the error after as a share of the measured signal's standard deviation."
        )
    ]
    outputs = list(dict.fromkeys((row["output"], row["role"]) for row in rows))
    if len(rows) > len(outputs):
        own = [[r for r in rows if (r["output"], r["role"]) == key] for key in outputs]
        blocks.append(_table("By output, over all experiments", own, pooled=True))
    folded = len(rows) > MOST_OPEN
    blocks.append(_table("By experiment", [[row] for row in rows], folded=folded))
    return ReportSection("errors", "Errors before and after", tuple(blocks))


def _table(
    caption: str, groups: Sequence[Sequence[Row]], *, pooled: bool = False, folded: bool = False
) -> TableBlock:
    first = "#experiments" if pooled else "experiment"
    names = columns("output", "", first, "#before", "#after", "unit", "#change",
                    "#of the signal", "#samples")  # fmt: skip
    lines = []
    for group in groups:
        before, after = (_pooled(group, f"rmse_{when}") for when in ("before", "after"))
        who = str(len(group)) if pooled else str(group[0]["experiment"])
        lines.append(
            cells(
                TableCell(group[0]["output"], code=True),
                TableCell(ROLES.get(str(group[0]["role"]), ""), "faint"),
                who,
                digits(before),
                digits(after),
                group[0]["unit"],
                _change(before, after) if any(r["samples"] for r in group) else TableCell(""),
                percent(_pooled(group, "relative_after")),
                count(sum(row["samples"] for row in group)),
            )
        )
    return TableBlock(names, tuple(lines), caption, folded)


def _pooled(rows: Sequence[Row], name: str) -> float:
    rows = [row for row in rows if row["samples"]]  # others have no error, and have not failed
    samples = sum(row["samples"] for row in rows)
    if not samples:
        return math.nan
    return math.sqrt(sum(row["samples"] * row[name] ** 2 for row in rows) / samples)


def _change(before: float, after: float) -> TableCell:
    if math.isnan(before) or math.isnan(after) or before <= 0.0:
        return TableCell("failed", "bad") if math.isnan(after) else TableCell("")
    share = after / before - 1.0
    tone: Tone = "good" if share < -0.005 else "bad" if share > 0.005 else "faint"
    sign = "+" if share > 0.0 else ""
    return TableCell(f"{sign}{percent(share)}" if abs(share) >= 5e-4 else "none", tone)
