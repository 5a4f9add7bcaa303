"""Parameters before and after, how they hang together, and what the data do not determine."""

from __future__ import annotations

import math

import numpy as np

from cluster_est.report.blocks import (
    Block,
    ItemsBlock,
    MapBlock,
    MapCell,
    ReportSection,
    TableBlock,
    TableCell,
    TextBlock,
    cells,
    columns,
)
from cluster_est.report.folder import ReportedRun, Row
from cluster_est.report.numbers import MINUS, beside, compact, digits, interval, percent
from workers.messages import FloatArray

MOST_IN_MAP = 60
MOST_OPEN = 30
STRONG = 0.95
"""Correlation beyond which two parameters are named."""


def parameters(run: ReportedRun) -> ReportSection:
    """Tables of estimates, intervals, constraints; correlations; directions."""
    rows = run.tables["parameters"]
    if not rows:
        return ReportSection("parameters", "Parameters", ())
    blocks: list[Block] = [TextBlock(text, "bad") for text in run.residual_sentences]
    blocks.append(_table(run, rows))
    blocks += _intervals(run) + _constraints(run) + _directions(run) + _correlations(run)
    return ReportSection("parameters", "Parameters", tuple(blocks))


def _table(run: ReportedRun, rows: tuple[Row, ...]) -> TableBlock:
    loop = run.is_loop
    more = ("#before", "#95 % interval") if loop else ("#start",)
    found = "#95 % interval (too narrow)" if run.too_narrow else "#95 % interval"
    names = columns("parameter", *more, "#after", found, "unit", "bounds", "")
    lines = []
    for row in rows:
        width = row["upper95"] - row["lower95"]
        if loop:
            earlier = _width(row, "_before")
            then = [beside(row["value_before"], earlier), _interval(row, "_before")]
        else:
            then = [digits(row["start"])]
        lines.append(
            cells(
                TableCell(row["label"], code=True),
                *then,
                beside(row["value"], width),
                _interval(row),
                row["unit"],
                TableCell(_bounds(row), "faint"),
                _remark(row),
            )
        )
    return TableBlock(names, tuple(lines), folded=len(lines) > MOST_OPEN,
                 caption=f"{len(lines)} parameters" if len(lines) > MOST_OPEN else "")  # fmt: skip


def _width(row: Row, when: str = "") -> float:
    low, high = row[f"lower95{when}"], row[f"upper95{when}"]
    return math.nan if low is None or high is None else float(high - low)


def _interval(row: Row, when: str = "") -> str:
    return interval(row[f"lower95{when}"], row[f"upper95{when}"])


def _bounds(row: Row) -> str:
    if not (math.isfinite(row["lower"]) or math.isfinite(row["upper"])):
        return ""
    return f"{compact(row['lower'])} … {compact(row['upper'])}"


def _remark(row: Row) -> TableCell:
    if row["at_bound"]:
        return TableCell(f"at its {row['at_bound']} bound", "bad")
    if row["estimated_on"] == "known":
        return TableCell("fixed", "faint")
    if row["estimated_on"] == "derived":
        return TableCell("derived", "faint")
    if math.isnan(row["lower95"]):
        return TableCell("not determined", "bad")
    return TableCell("held out" if row["estimated_on"] == "test" else "", "faint")


def _intervals(run: ReportedRun) -> list[Block]:
    rows = run.tables["intervals"]
    if not rows:
        return []
    names = columns("parameter", "from", "#confidence", "#lower", "#upper")
    lines = tuple(
        cells(
            TableCell(row["label"], code=True),
            row["source"],
            percent(row["confidence"]),
            row["open_lower"] or digits(row["lower"]),
            row["open_upper"] or digits(row["upper"]),
        )
        for row in rows
    )
    return [TableBlock(names, lines, "Intervals that took refits or draws")]


def _constraints(run: ReportedRun) -> list[Block]:
    rows = run.tables["constraints"]
    if not rows:
        return []
    names = columns("constraint", "must be", "#before", "#after", "")
    lines = tuple(
        cells(
            TableCell(row["constraint"], code=True),
            row["kind"],
            digits(row["before"]),
            digits(row["after"]),
            TableCell("kept", "good") if row["satisfied"] else TableCell("violated", "bad"),
        )
        for row in rows
    )
    return [TableBlock(names, lines, "Constraints, over their scales")]


def _directions(run: ReportedRun) -> list[Block]:
    found = tuple(dict.fromkeys(row["sentence"] for row in run.tables["directions"]))
    if not found:
        return []
    return [TextBlock("What the data do not determine", kind="heading"), ItemsBlock(found)]


def _correlations(run: ReportedRun) -> list[Block]:
    rows = run.tables["correlations"]
    labels = list(dict.fromkeys([row["other"] for row in rows] + [row["label"] for row in rows]))
    if len(labels) < 2:
        return []
    blocks: list[Block] = []
    strong = sorted((r for r in rows if abs(r["correlation"]) > STRONG),
                    key=lambda r: -abs(r["correlation"]))[:10]  # fmt: skip
    if strong:
        named = tuple(f"{r['label']} and {r['other']}: {r['correlation']:.3f}" for r in strong)
        blocks.append(TextBlock(f"Correlations beyond {STRONG} in size:"))
        blocks.append(ItemsBlock(named))
    blocks.append(_map(labels[:MOST_IN_MAP], rows))
    if len(labels) > MOST_IN_MAP:
        blocks.append(
            TextBlock(f"The map shows {MOST_IN_MAP} of {len(labels)} parameters.", "faint")
        )
    return blocks


def _two_places(value: float) -> str:
    return (
        f"{value + 0.0:.2f}".replace("-0.00", "0.00").replace("-", MINUS)
        if math.isfinite(value)
        else ""
    )


def _map(labels: list[str], rows: tuple[Row, ...]) -> MapBlock:
    place = {label: i for i, label in enumerate(labels)}
    matrix = np.full((len(labels), len(labels)), np.nan)
    for row in rows:
        if row["label"] in place and row["other"] in place:
            i, j = sorted((place[row["label"]], place[row["other"]]))
            matrix[j, i] = row["correlation"]
    small = len(labels) <= 14
    lines = tuple(
        (labels[j], tuple(_cell(labels, matrix, i, j, small=small) for i in range(len(labels) - 1)))
        for j in range(1, len(labels))  # below the diagonal: the rest says the same again
    )
    return MapBlock(
        "Correlations",
        tuple(labels[:-1]),
        lines,
        "How far an error of one estimate goes with an error of another: where the size is near 1, "
        "the data hardly tell the two apart.",
    )


def _cell(labels: list[str], matrix: FloatArray, i: int, j: int, *, small: bool) -> MapCell:
    value = float(matrix[j, i])
    if i >= j or not math.isfinite(value):
        return MapCell(None)
    text = _two_places(value)
    return MapCell(value, text if small else "", f"{labels[j]}, {labels[i]}: {text}")
