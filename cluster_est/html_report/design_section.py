"""The section on a design: the input, predictions of the models, and expected information."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from cluster_est.experiment_design.design_sentences import block_for_table, times
from cluster_est.html_report.charts import (
    Band,
    Chart,
    Line,
    Mark,
    Plot,
)
from cluster_est.html_report.number_text import digits
from cluster_est.html_report.page_blocks import (
    Block,
    FigureBlock,
    ReportSection,
    SourceBlock,
    TableLine,
    code,
    table,
    with_unit,
)
from cluster_est.html_report.reported_run import ReportedRun, Row
from cluster_est.html_report.scales import Scale
from cluster_est.problem.display import percent
from workers.messages import FloatArray

MOST_MODELS = 5
"""Largest number of models whose predictions are drawn."""
COVERED = 1.96
Curve = tuple[FloatArray, FloatArray, FloatArray]
INPUT_NOTE = "{} contains this input, ready for the experiment."
OUTPUT_NOTE = (
    "Each curve is the prediction of one model. The bands show the uncertainty from its parameters "
    "(95 %), without sensor noise. Where the curves differ, the measurement will distinguish the "
    "models."
)


def design(run: ReportedRun) -> ReportSection:
    """Return the section on the expected results of a design; empty for other runs."""
    if not run.is_design:
        return ReportSection("design", "", ())
    table_of_input, base = run.beside(".csv"), run.facts.get("config_folder")
    block = block_for_table(run.facts["design"]["block"], table_of_input, base)
    blocks = [*_tables(run)[1:], SourceBlock("Lines for the config", block)]
    return ReportSection("design", "What the experiment is expected to tell", tuple(blocks))


def design_table(run: ReportedRun) -> list[Block]:
    """Return the table for the purpose of the design, for the head of a page."""
    return _tables(run)[:1]


def _tables(run: ReportedRun) -> list[Block]:
    """Return tables of models, predictions and parameters, in the order of the design's purpose."""
    return [*_models(run), *_rivals(run), *_predictions(run), *_parameters(run)]


def design_pictures(run: ReportedRun) -> list[FigureBlock]:
    """Return the input and the models' predictions, for the head of a page."""
    units = run.facts["design"].get("units") or {}
    note = INPUT_NOTE.format(f"{run.name}.csv, next to the run's folder,")
    return [
        *_inputs(run.tables["next_input"], units, note),
        *_outputs(run.tables["expected"], units),
    ]


def _inputs(rows: Sequence[Row], units: Mapping[str, str], note: str) -> list[FigureBlock]:
    time = np.array([row["time"] for row in rows])
    plots = []
    for name in rows[0] if rows else ():
        if name == "time" or rows[0][name] is None or math.isnan(rows[0][name]):
            continue
        line = Line(name, "after", time, np.array([row[name] for row in rows]))
        label = with_unit(name, units.get(name, ""))
        plots.append(Plot(name, label, Scale.around(time), Scale.around(line.y), [line], 130))
    if not plots:
        return []
    chart = Chart(tuple(plots), "time (s)", legend=False, across=5)
    return [FigureBlock("next-input", "Input of the experiment", chart, note)]


def _outputs(rows: Sequence[Row], units: Mapping[str, str]) -> list[FigureBlock]:
    plots = []
    for output in dict.fromkeys(row["output"] for row in rows):
        models = _curves([row for row in rows if row["output"] == output])
        first, reference = next(iter(models.items()))
        unit = units.get(output, "")
        plots.append(_plot(with_unit(output, unit), models))
        if len(models) > 1:
            others = {
                name: (time, expected - reference[1], error)
                for name, (time, expected, error) in models.items()
                if name != first and len(time) == len(reference[0])
            }
            label = with_unit(f"{output} minus that of {first}", unit)
            plots.append(_plot(label, others, begin=1))
    chart = Chart(tuple(plots), "time (s)", across=5)
    return [FigureBlock("expected", "Predicted outputs", chart, OUTPUT_NOTE)] if plots else []


def _curves(rows: Sequence[Row]) -> dict[str, Curve]:
    """Return time, expected value and its error, for each of the leading models."""
    found = {}
    for model in list(dict.fromkeys(row["model"] for row in rows))[:MOST_MODELS]:
        own = [row for row in rows if row["model"] == model]
        time, expected, error = (
            np.array([row[key] for row in own]) for key in ("time", "expected", "std_error")
        )
        found[model] = (time, expected, error)
    return found


def _plot(label: str, models: Mapping[str, Curve], begin: int = 0) -> Plot:
    """Return curves with their bands, in inks numbered from `begin`."""
    marks: list[Mark] = []
    for number, (model, (time, expected, error)) in enumerate(models.items(), begin):
        ink, band = f"series-{number}", COVERED * error
        marks.append(Band("", ink, time, expected - band, expected + band))
        marks.append(Line(model, ink, time, expected))
    lines = [mark for mark in marks if isinstance(mark, Line)]
    across = Scale.around(*(line.x for line in lines))
    upright = Scale.around(*(line.y for line in lines), np.zeros(1) if begin else lines[0].y)
    return Plot(label, label, across, upright, marks, 150 if begin else 220)


def _models(run: ReportedRun) -> list[Block]:
    models = run.tables["probabilities"]
    if not models:
        return []
    lines: list[TableLine] = [
        (
            code(row["model"]),
            *(
                "" if math.isnan(row[key]) else percent(row[key])
                for key in ("before", "after", "random", "recorded")
            ),
        )
        for row in models
    ]
    names = ("if this is right", "#now", "#after it", "#a random input", "#a recorded input")
    said = (
        "Probability of each model if it is the right one, now and as expected after the "
        "experiment; rivals that no input distinguishes from it are left out"
    )
    return [table(names, lines, said)]


def _rivals(run: ReportedRun) -> list[Block]:
    evidence = run.tables["evidence"]
    if not evidence:
        return []
    first = run.tables["probabilities"][0]["model"]
    lines: list[TableLine] = [
        (code(row["rival"]), *(times(row[key]) for key in ("evidence", "random", "best")))
        for row in evidence
        if row["true_model"] == first
    ]
    names = ("rival", "#after it", "#a random input", "#at best")
    return [
        table(
            names,
            lines,
            f"How many times less likely each rival is expected to become if {first} is right",
        )
    ]


def _parameters(run: ReportedRun) -> list[Block]:
    rows = run.tables["precision"]
    names = ("parameter", "#value", "unit", "#standard error now", "#after it", "#a random input")
    lines: list[TableLine]
    lines = [(code(row["label"]), digits(row["value"]), row["unit"], *_errors(row)) for row in rows]
    return [table(names, lines, "Expected effect of the experiment on the parameters")]


def _errors(row: Row) -> list[str]:
    """Return the standard error now, after the experiment, and after a random input."""
    return [digits(row[key]) for key in ("std_error_before", "std_error_after", "random")]


def _predictions(run: ReportedRun) -> list[Block]:
    rows = run.tables["prediction_precision"]
    if not rows:
        return []
    return [
        table(
            ("predicted", "of", "unit", "#standard deviation now", "#after it", "#a random input"),
            [(code(r["output"]), r["experiment"], r["unit"], *_errors(r)) for r in rows],
            "Expected uncertainty of the predictions before and after the experiment: the part "
            "that comes from the parameters, as a root mean square over the samples",
        )
    ]
