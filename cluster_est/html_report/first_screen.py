"""The first screen of a report: the result, its certainty, and the agreement with the data.

Texts are on the left and pictures on the right; on a narrow screen, pictures are below the texts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from cluster_est.html_report.curve_section import RecordCharts, lead_figures
from cluster_est.html_report.design_section import design_pictures, design_table
from cluster_est.html_report.effect_sections import effect_words, lead_shape, sure_words
from cluster_est.html_report.error_sections import error_table
from cluster_est.html_report.number_text import beside, digits, percent
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    TableCell,
    TextBlock,
    table,
)
from cluster_est.html_report.parameter_sections import order_of_estimation, ranking_picture
from cluster_est.html_report.reported_run import ReportedRun, Row

MOST_PARAMETERS = 8
"""Number of rows of the table of parameters; the section on parameters has all."""


@dataclass(frozen=True)
class FirstScreen:
    """Contents side by side below the headline; `more` is below the next steps."""

    words: tuple[Block, ...]
    pictures: tuple[FigureBlock, ...]
    more: tuple[Block, ...] = ()


def first_screen(run: ReportedRun, charts: RecordCharts) -> FirstScreen:
    """Return the main results of a run; empty if it has none yet."""
    if run.is_design:
        return FirstScreen(tuple(design_table(run)), tuple(design_pictures(run)))
    if run.is_sensitivity:
        return FirstScreen(tuple(order_of_estimation(run)), tuple(ranking_picture(run)))
    if not run.finished:
        return FirstScreen((), ())
    words = (*effect_words(run), *parameter_table(run), *error_table(run))
    shape, leads = lead_shape(run), lead_figures(charts)
    pictures = (*shape, *(reversed(leads) if shape else leads))
    return FirstScreen(words, pictures, tuple(sure_words(run)))


def parameter_table(run: ReportedRun, rest: str = "see Parameters") -> list[Block]:
    """Return the shared estimates with absolute and relative 95 % intervals, and meanings.

    `rest` says where to find the other parameters.
    """
    rows = [row for row in run.tables["parameters"] if row["estimated_on"] != "known"]
    shared = [row for row in rows if row.get("scope", "shared") == "shared"]
    chosen = (shared or rows)[:MOST_PARAMETERS]
    if not chosen:
        return []
    words = {each["name"]: each["words"] for each in run.facts.get("effects") or ()}
    sure = "#± (too narrow)" if run.too_narrow else "#± (95 %)"
    names = ("parameter", "#value", sure, "#± %", "unit")
    blocks: list[Block] = [table(names, [_line(row, words) for row in chosen])]
    left = len(run.tables["parameters"]) - len(chosen)
    if left:
        blocks.append(TextBlock(f"{left} more: {rest}.", "faint"))
    return blocks


def _line(row: Row, words: dict[str, str]) -> tuple[str | TableCell, ...]:
    """Return a row of the table of parameters."""
    sure: tuple[str | TableCell, str]
    half = 0.5 * (row["upper95"] - row["lower95"])
    what = row.get("description") or words.get(row["label"].partition(".")[0], "")
    name = TableCell(row["label"], code=True, more=what)
    if row["at_bound"]:
        sure = TableCell(f"at its {row['at_bound']} bound", "bad"), ""
    elif math.isnan(half):
        sure = TableCell("not determined", "bad"), ""
    else:
        share = abs(half / row["value"]) if row["value"] else math.nan
        sure = digits(half, 2), percent(share, 2) if share < 1.0 else ""
    return name, beside(row["value"], 2.0 * half), *sure, row["unit"]
