"""Sections on parameters: estimates and correlations, or their influence."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from cluster_est.html_report.charts import (
    Chart,
    Dots,
    Line,
    Plot,
    row_chart,
)
from cluster_est.html_report.number_text import MINUS, beside, compact, digits, interval, percent
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    ItemsBlock,
    MapBlock,
    MapCell,
    ReportSection,
    TableBlock,
    TableCell,
    TextBlock,
    code,
    table,
)
from cluster_est.html_report.reported_run import ReportedRun, Row
from cluster_est.html_report.scales import Scale
from cluster_est.html_report.search_sections import profiles
from workers.messages import FloatArray

MOST_IN_MAP = 60
MOST_UNFOLDED_PARAMETERS = 30
STRONG = 0.95
"""Correlation above which two parameters are named."""


def parameters(run: ReportedRun) -> ReportSection:
    """Return the section with estimates, intervals, constraints, correlations and directions."""
    rows = run.tables["parameters"]
    if not rows:
        return ReportSection("parameters", "Parameters", ())
    blocks: list[Block] = [_table(run, rows)]
    blocks += [*_directions(run), *_correlations(run), *profiles(run)]
    blocks += [*_intervals(run), *_constraints(run)]
    return ReportSection("parameters", "Parameters", tuple(blocks))


def _table(run: ReportedRun, rows: tuple[Row, ...]) -> TableBlock:
    loop = run.is_loop
    more = ("#before", "#95 % interval") if loop else ("#start",)
    found = "#95 % interval (too narrow)" if run.too_narrow else "#95 % interval"
    names = ("parameter", *more, "#after", found, "unit", "bounds", "")
    lines = []
    for row in rows:
        width = row["upper95"] - row["lower95"]
        if loop:
            earlier = _width(row, "_before")
            then = [beside(row["value_before"], earlier), _interval(row, "_before")]
        else:
            then = [digits(row["start"])]
        lines.append(
            (
                TableCell(row["label"], code=True, more=row.get("description") or ""),
                *then,
                beside(row["value"], width),
                _interval(row),
                row["unit"],
                TableCell(_bounds(row), "faint"),
                _remark(row),
            )
        )
    many = len(lines) > MOST_UNFOLDED_PARAMETERS
    return table(names, lines, f"{len(lines)} parameters" if many else "", folded=many)


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
    lines = [
        (
            code(row["label"]),
            row["source"],
            percent(row["confidence"]),
            row["open_lower"] or digits(row["lower"]),
            row["open_upper"] or digits(row["upper"]),
        )
        for row in run.tables["intervals"]
    ]
    names = ("parameter", "from", "#confidence", "#lower", "#upper")
    return [table(names, lines, "Intervals from refits or draws")] if lines else []


def _constraints(run: ReportedRun) -> list[Block]:
    lines = [
        (
            code(row["constraint"]),
            row["kind"],
            *(digits(row[when]) for when in ("before", "after")),
            TableCell("kept", "good") if row["satisfied"] else TableCell("violated", "bad"),
        )
        for row in run.tables["constraints"]
    ]
    names = ("constraint", "must be", "#before", "#after", "")
    return [table(names, lines, "Constraints, divided by their scales")] if lines else []


def _directions(run: ReportedRun) -> list[Block]:
    found = tuple(dict.fromkeys(row["sentence"] for row in run.tables["directions"]))
    if not found:
        return []
    return [TextBlock("Undetermined directions", kind="heading"), ItemsBlock(found)]


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
        blocks.append(TextBlock(f"Correlations above {STRONG} in absolute value:"))
        blocks.append(ItemsBlock(named))
    blocks.append(_map(labels[:MOST_IN_MAP], rows))
    if len(labels) > MOST_IN_MAP:
        blocks.append(
            TextBlock(f"The map shows {MOST_IN_MAP} of {len(labels)} parameters.", "faint")
        )
    return blocks


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
        for j in range(1, len(labels))  # below the diagonal, because the map is symmetric
    )
    return MapBlock(
        "Correlations",
        tuple(labels[:-1]),
        lines,
        "Correlation between the errors of two estimates: if its absolute value is close to 1, "
        "the data can hardly distinguish the two.",
    )


def _cell(labels: list[str], matrix: FloatArray, i: int, j: int, *, small: bool) -> MapCell:
    value = float(matrix[j, i])
    if i >= j or not math.isfinite(value):
        return MapCell(None)
    text = f"{value + 0.0:.2f}".replace("-0.00", "0.00").replace("-", MINUS)
    return MapCell(value, text if small else "", f"{labels[j]}, {labels[i]}: {text}")


MOST_RANKED, MOST_UNKNOWNS_OVER_TIME, MOST_OUTPUTS_OVER_TIME = 40, 6, 12
"""Largest numbers of unknowns in the ranking, and of unknowns and outputs over time."""

RANKING_NOTE = (
    "The error bars are 95 % intervals; a parameter with an index of 0 does not change the cost."
)
TIME_NOTE = (
    "Where a curve is high, that part of the record contains information about the parameter."
)


def sensitivity(run: ReportedRun) -> ReportSection:
    """Return the section of a sensitivity analysis on influence over time; empty for other runs."""
    rows = run.tables["ranking"]
    found = run.facts.get("sensitivity") or {}
    blocks = _over_time(run, found["ranks"]) if rows and found else []
    return ReportSection("sensitivity", "What matters, and when", tuple(blocks))


def ranking_picture(run: ReportedRun) -> list[FigureBlock]:
    """Return the ranking of a sensitivity analysis with intervals, for the head of a page."""
    rows, ranks = run.tables["ranking"], run.facts["sensitivity"]["ranks"]
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
    chart = row_chart(title, title, across, marks, names)
    return [FigureBlock("ranking", title, chart, RANKING_NOTE)]


def order_of_estimation(run: ReportedRun) -> list[Block]:
    """Return the table of the order of estimation, for the head of a page."""
    rows = run.tables["ranking"]
    ordered = sorted(rows, key=lambda row: (row["position"] < 0, row["position"]))
    lines = [
        (code(row["label"]), digits(row["size"]), _index(row["collinearity"]), _together(row))
        for row in ordered
    ]
    names = ("parameter", "#seen, in sigmas", "#collinearity", "estimate together")
    said = "The best order of estimation, from derivatives at the start values"
    return [table(names, lines, said)] if lines else []


def _over_time(run: ReportedRun, ranks: str) -> list[Block]:
    """Return a chart of the most influential parameters for each output of each experiment."""
    index = ranks.partition(" of ")[0]
    found: dict[tuple[str, str], dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in run.tables["indices"]:
        if row["index"] == index and row["experiment"]:
            found[row["experiment"], row["output"]][row["label"]].append(row)
    blocks: list[Block] = []
    for number, ((experiment, output), own) in enumerate(
        list(found.items())[:MOST_OUTPUTS_OVER_TIME]
    ):
        peaks = {
            label: max((row["value"] for row in rows if math.isfinite(row["value"])), default=0.0)
            for label, rows in own.items()
        }
        named = sorted(peaks, key=lambda label: -peaks[label])[:MOST_UNKNOWNS_OVER_TIME]
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
    return "unknown" if math.isinf(value) else digits(value, 3)


def _together(row: Row) -> str:
    if row["position"] < 0:
        return ""
    return "yes" if row["together"] else "no: fix this value, or measure more"
