"""The report of a sweep: its runs beside each other, from its summary table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cluster_est.html_report.charts import Dots, Mark, Scale, row_chart
from cluster_est.html_report.number_text import count, digits, duration
from cluster_est.html_report.page import rendered, write_page
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    ReportSection,
    TableCell,
    TableLine,
    TextBlock,
    Tone,
    code,
    table,
)
from cluster_est.html_report.reported_run import Row
from cluster_est.run_folder.run_files import SWEEP_SUMMARY_FILE, RunWorth, read_run_table, run_worth

PAGE = "report.html"
PARAMETER = "parameter "
"""Begins the names of the columns of shared estimates."""
MOST_DRAWN = 60
"""Runs of a picture: the best ones."""
COLUMNS_OF_EVERY_SWEEP = (
    "run", "config", "status", "message", "doubts", "cost_before", "cost", "rmse_train",
    "rmse_test", "iterations", "evaluations", "simulations", "failures", "seconds", "seed",
    "started",
)  # fmt: skip
"""Columns that every sweep has; the others are its axes and its parameters."""


def is_sweep(folder: Path) -> bool:
    """Return whether a folder is that of a sweep."""
    return (folder / SWEEP_SUMMARY_FILE).is_file()


def write_sweep_report(folder: Path, out: Path | None = None) -> Path:
    """Write the report of a sweep, in one step.

    Parameters
    ----------
    folder
        Of the sweep, finished or not.
    out
        The file to write; report.html in the folder if None.

    Raises
    ------
    RunFolderError
        If its summary is damaged, or the file cannot be written.
    """
    path = folder / PAGE if out is None else out
    rows = read_run_table(folder / SWEEP_SUMMARY_FILE)
    states = Counter(row["status"] for row in rows)
    done = states["done"]
    worths = Counter(_worth(row) for row in rows)
    doubtful = worths[RunWorth.DOUBTFUL]
    tone: Tone = "good" if worths[RunWorth.GOOD] == len(rows) else "bad" if not done else ""
    title = f"{count(done)} of {count(len(rows))} runs reached a solution"
    if doubtful:
        of = "all" if doubtful == done else count(doubtful)
        title += f"; {of} of these {'is' if of == '1' else 'are'} doubtful"
    sections = (errors(rows), _estimates(rows), _runs(rows))
    page = rendered(
        "sweep.html",
        name=folder.resolve().name,
        title=title,
        tone=tone,
        sentences=_sentences(rows, states),
        sections=[section for section in sections if section.blocks],
    )
    write_page(path, page)
    return path


def _sentences(rows: Sequence[Row], states: Counter[str]) -> list[str]:
    others = [f"{count(n)} {state}" for state, n in states.items() if state != "done"]
    found = [f"Of the others: {', '.join(others)}."] if others else []
    for name, words in (("rmse_test", "held-out"), ("rmse_train", "training")):
        best = min(
            (r for r in rows if _known(r, name)), key=lambda r: _value(r, name), default=None
        )
        if best is not None:
            size = digits(best[name], 3)
            found.append(f"The least {words} error, {size} over sigma, is that of {best['run']}.")
    return found


def _worth(row: Row) -> RunWorth:
    return run_worth(row["status"], row["doubts"])


def _value(row: Row, name: str) -> float:
    found = row.get(name)
    return math.nan if found is None else float(found)


def _known(row: Row, name: str) -> bool:
    return math.isfinite(_value(row, name))


def _ranked(rows: Sequence[Row]) -> list[Row]:
    """Runs with an error, the best first: by the held-out one where each of them has it."""
    ended = [row for row in rows if _known(row, "rmse_train")]
    name = "rmse_test" if all(_known(row, "rmse_test") for row in ended) else "rmse_train"
    return sorted(ended, key=lambda row: _value(row, name))


def errors(rows: Sequence[Row]) -> ReportSection:
    """Training and held-out errors of the runs in one picture."""
    drawn = _ranked(rows)[:MOST_DRAWN]
    if not drawn:
        return ReportSection("errors", "Errors", ())
    place = np.arange(len(drawn), dtype=float)
    sizes = {n: np.array([_value(r, n) for r in drawn]) for n in ("rmse_train", "rmse_test")}
    marks: list[Mark] = [
        Dots(name, ink, sizes[column], place)
        for column, name, ink in (
            ("rmse_train", "training", "after"),
            ("rmse_test", "held out", "before"),
        )
        if np.isfinite(sizes[column]).any()
    ]
    across = Scale.around(*sizes.values(), may_be_log=True)
    title = "Errors of the runs, the best first"
    figure = _by_run("errors-of-runs", title, "error over sigma", across, marks, drawn)
    return ReportSection("errors", "Errors", (figure, *_left_out(rows, drawn)))


def _by_run(
    name: str, title: str, below: str, across: Scale, marks: Sequence[Mark], drawn: Sequence[Row]
) -> FigureBlock:
    """A picture with a row for each run."""
    axes = _axes(drawn)
    choices = [", ".join(str(row[axis]) for axis in axes if row[axis]) for row in drawn]
    names = [own or row["run"] for own, row in zip(choices, drawn, strict=True)]
    chart = row_chart(title, below, across, marks, names, legend=len(marks) > 1)
    return FigureBlock(name, title, chart)


def _axes(rows: Sequence[Row]) -> list[str]:
    """The names of the sweep's axes."""
    names = rows[0] if rows else ()
    return [
        name
        for name in names
        if name not in COLUMNS_OF_EVERY_SWEEP and not name.startswith(PARAMETER)
    ]


def _left_out(rows: Sequence[Row], drawn: Sequence[Row]) -> list[Block]:
    left = len(rows) - len(drawn)
    said = f"{count(left)} of {count(len(rows))} runs are not drawn; the table has all of them."
    return [TextBlock(said, "faint")] if left else []


def _estimates(rows: Sequence[Row]) -> ReportSection:
    """The shared estimates of the runs, a picture for each parameter."""
    drawn = _ranked(rows)[:MOST_DRAWN]
    names = [name for name in (rows[0] if rows else ()) if name.startswith(PARAMETER)]
    place = np.arange(len(drawn), dtype=float)
    figures = []
    for number, name in enumerate(names):
        values = np.array([_value(row, name) for row in drawn])
        if np.isfinite(values).any():
            label = name.removeprefix(PARAMETER)
            marks = [Dots(label, "after", values, place)]
            across = Scale.around(values)
            title = f"Estimates of {label}"
            figures.append(_by_run(f"estimates-{number}", title, label, across, marks, drawn))
    return ReportSection("estimates", "Estimates", tuple(figures))


def _runs(rows: Sequence[Row]) -> ReportSection:
    """The summary table as people read it."""
    axes = _axes(rows)
    names = ("run", *axes, "", "#training", "#held out", "#cost", "#simulations", "#time")
    lines: list[TableLine] = [
        (
            code(row["run"]),
            *(str(row[axis]) for axis in axes),
            TableCell("; ".join(filter(None, (row["status"], row["doubts"]))), _worth(row).value),
            digits(_value(row, "rmse_train")),
            digits(_value(row, "rmse_test")),
            digits(_value(row, "cost")),
            count(_value(row, "simulations")) if _known(row, "simulations") else "",
            duration(_value(row, "seconds")) if _known(row, "seconds") else "",
        )
        for row in rows
    ]
    reasons = tuple(
        (code(row["run"]), row["status"], row["message"])
        for row in rows
        if row["status"] != "done" and row["message"]
    )
    blocks: list[Block] = [table(names, lines)] if lines else []
    if reasons:
        blocks.append(table(("run", "", "why"), reasons, "Reasons of failed runs"))
    return ReportSection("runs", "Runs", tuple(blocks))
