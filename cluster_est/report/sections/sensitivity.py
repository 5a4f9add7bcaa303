"""The section on a sensitivity analysis: the ranking, and what matters when."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from cluster_est.report.blocks import (
    Block,
    FigureBlock,
    ReportSection,
    TableBlock,
    TableCell,
    columns,
)
from cluster_est.report.drawing import Chart, Dots, Line, Plot, Scale
from cluster_est.report.drawing.chart import gutter
from cluster_est.report.folder import ReportedRun, Row
from cluster_est.report.numbers import digits

MOST_RANKED, MOST_LINES, MOST_PANELS = 40, 6, 12
"""Unknowns in the picture of the ranking, unknowns over time, outputs over time."""

RANKING_NOTE = "The bars are 95 % intervals; what stands at 0 does not change the cost."
TIME_NOTE = "Where a curve is high, that part of a record says something about the parameter."


def sensitivity(run: ReportedRun) -> ReportSection:
    """Everything that a sensitivity analysis has found; nothing for other runs."""
    rows = run.tables["ranking"]
    found = run.facts.get("sensitivity") or {}
    blocks: list[Block] = []
    if rows and found:
        blocks = [*_ranking(rows, found["ranks"]), _order(rows), *_over_time(run, found["ranks"])]
    return ReportSection("sensitivity", "What matters, and when", tuple(blocks))


def _ranking(rows: tuple[Row, ...], ranks: str) -> list[Block]:
    known = [row for row in rows if math.isfinite(row["value"])][:MOST_RANKED]
    if not known:
        return []
    names = [row["label"] for row in known]
    place = np.arange(len(known), dtype=float)
    values = np.array([row["value"] for row in known])
    half = np.nan_to_num([row["half_width"] for row in known])
    bars = [
        Line("" if i else "95 % interval", "faint", values[i] + half[i] * np.array([-1.0, 1.0]),
             np.full(2, place[i]))
        for i in range(len(known))
    ]  # fmt: skip
    across = Scale.around(values + half, values - half, np.zeros(1))
    title = _called(ranks)
    marks = [*bars, Dots(ranks, "after", values, place)]
    upright = Scale(len(known) - 0.5, -0.5)
    plot = Plot(title, "", across, upright, marks, max(60, 20 * len(known)), names)
    chart = Chart((plot,), _called(ranks), gutter=gutter(names), zooms=False)
    return [FigureBlock("ranking", title, chart, RANKING_NOTE)]


def _order(rows: tuple[Row, ...]) -> Block:
    """The table of the order of estimation."""
    ordered = sorted(rows, key=lambda row: (row["position"] < 0, row["position"]))
    return TableBlock(
        columns("parameter", "#seen, in sigmas", "#collinearity", "estimate together"),
        tuple(
            (
                TableCell(row["label"], code=True),
                TableCell(digits(row["size"])),
                TableCell(_index(row["collinearity"])),
                TableCell(_together(row)),
            )
            for row in ordered
        ),
        "The order in which parameters are best estimated, from derivatives at the start values",
    )


def _over_time(run: ReportedRun, ranks: str) -> list[Block]:
    """A chart for each output of each experiment, of the parameters that matter most in it."""
    index = ranks.partition(" of ")[0]
    found: dict[tuple[str, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in run.tables["indices"]:
        if row["index"] == index and row["experiment"]:
            found[row["experiment"], row["output"]][row["label"]].append(row)
    blocks: list[Block] = []
    for number, ((experiment, output), own) in enumerate(list(found.items())[:MOST_PANELS]):
        peaks = {
            label: max((row["value"] for row in rows if math.isfinite(row["value"])), default=0.0)
            for label, rows in own.items()
        }
        named = sorted(peaks, key=lambda label: -peaks[label])[:MOST_LINES]
        marks = [
            Line(label, f"series-{i}", np.array([row["time"] for row in own[label]]),
                 np.array([row["value"] for row in own[label]]))
            for i, label in enumerate(named)
        ]  # fmt: skip
        title = _called(f"{index} of {output} in {experiment}")
        across = Scale.around(*(mark.x for mark in marks))
        upright = Scale.around(*(mark.y for mark in marks), np.zeros(1))
        plot = Plot(title, index, across, upright, marks)
        note = "" if number else TIME_NOTE
        blocks.append(FigureBlock(f"over-time-{number}", title, Chart((plot,), "time in s"), note))
    return blocks


def _called(ranks: str) -> str:
    index, _, quantity = ranks.partition(" of ")
    name = "Total Sobol index" if index == "total" else "Mean absolute elementary effect"
    return f"{name} of {quantity}"


def _index(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return "cannot be told" if math.isinf(value) else digits(value, 3)


def _together(row: Row) -> str:
    if row["position"] < 0:
        return ""
    return "yes" if row["together"] else "no: fix it, or measure more"
