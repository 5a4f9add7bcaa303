"""Draw the pictures of the pages that are made from runs, each as an SVG file of its own.

    cluster-est close-loop configs/mass_with_friction.toml --out runs/friction
    cluster-est fit configs/mass_spring_damper.toml --out runs/spring
    cluster-est sensitivity configs/mass_with_friction.toml --out runs/ranked
    cluster-est sweep configs/sweep.toml --out runs/sweep
    cluster-est design runs/friction --limits configs/mass_with_friction_limits.toml --out next.csv
    python scripts/docs/run_pictures.py runs/friction runs/spring runs/ranked runs/sweep next

Writes cluster_est/docs/*.svg from the tables of those runs: parts of reports, with the reports' own
charts and colours, and of a closed loop the picture of the README, an experiment that was held out
as the fitted model follows it, with and without the effect that was found. Fits of one problem by
several methods make one picture, the costs over what each method has simulated::

    for m in least_squares pattern_search cmaes de; do
        cluster-est fit configs/mass_spring_damper.toml --out runs/$m method.name=$m
    done
    cluster-est fit configs/mass_spring_damper.toml --out runs/nelder_mead \\
        method.name=nelder_mead method.options.bounds=enforce
    python scripts/docs/run_pictures.py runs/least_squares runs/pattern_search runs/cmaes \\
        runs/de runs/nelder_mead

The files have colours for a light and for a dark page.
"""

from __future__ import annotations

import argparse
import importlib.resources
import json
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from markupsafe import Markup

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from docs.svg import RECORD_STYLE, Axes, document, legend, record, text

from cluster_est.html_report.charts import Chart
from cluster_est.html_report.curve_section import RecordCharts, lead_figures
from cluster_est.html_report.design_section import design_pictures
from cluster_est.html_report.effect_sections import lead_shape
from cluster_est.html_report.error_sections import error_picture
from cluster_est.html_report.page_blocks import FigureBlock
from cluster_est.html_report.parameter_sections import ranking_picture
from cluster_est.html_report.reported_run import ReportedRun, read_run
from cluster_est.html_report.search_sections import search
from cluster_est.html_report.sweep_page import errors, is_sweep, read_sweep_runs
from workers.messages import FloatArray

DOCS = Path(__file__).resolve().parents[2] / "cluster_est" / "docs"
REPORT_WIDTH = 820
AROUND = 92
"""Pixels of a chart besides its plots: title, legend, and what is written below."""
BETWEEN = 50
"""Pixels above and below each plot."""

REPORT_PICTURE = Markup(
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
    'height="{height}" role="img"><title>{title}</title><style>{style}</style>'
    '<foreignObject width="{width}" height="{height}">'
    '<div xmlns="http://www.w3.org/1999/xhtml" class="sheet"><figure>'
    "<figcaption>{title}</figcaption>{chart}</figure></div></foreignObject></svg>\n"
)
SHEET = """
.sheet { background: var(--page); color: var(--text); height: 100%; padding: 2px 14px;
  font: 14px/1.5 system-ui, sans-serif; }
.sheet figure { margin: 8px 0; }
"""


def main() -> None:
    """Read the runs and write the pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs, and of a sweep")
    runs = parser.parse_args().runs
    found = dict(each for folder in runs for each in pictures(folder))
    fits = [run for run in runs if (run / "searches.parquet").is_file() and not is_loop(run)]
    if len(fits) == len(runs) > 1:  # of one problem by several methods
        found = {"method_costs": costs_of_methods([read_descent(run) for run in fits])}
    for run in filter(is_loop, runs):
        found["closed_loop"] = closed_loop(run)
    for name, words in found.items():
        path = DOCS / f"{name}.svg"
        path.write_text(words, encoding="utf-8")
        print(path.name, f"{len(words) / 1e3:.0f} kB")


def is_loop(run: Path) -> bool:
    return not is_sweep(run) and read_run(run).is_loop


def pictures(folder: Path) -> Iterator[tuple[str, str]]:
    """The name and the text of each picture of a run."""
    if is_sweep(folder):
        (figure,) = errors(read_sweep_runs(folder))
        yield "sweep_errors", drawn(figure.title, figure.chart)
        return
    run = read_run(folder)
    if run.is_sensitivity:
        (figure,) = ranking_picture(run)
        yield "sensitivity_ranking", drawn(figure.title, figure.chart)
    elif run.is_design:
        yield "next_experiment", of_design(run)
    elif run.is_loop:
        yield from of_closed_loop(run)
    else:
        yield "first_fit", last_lead(run)


def of_design(run: ReportedRun) -> str:
    """The input, and what each model predicts of it, in one picture."""
    plots = [plot for figure in design_pictures(run) for plot in figure.chart.plots]
    return drawn("The next experiment", Chart(tuple(plots), "time (s)"))


def of_closed_loop(run: ReportedRun) -> Iterator[tuple[str, str]]:
    """The pictures of the page on the report."""
    found = error_picture(run)
    if found is not None:
        yield "report_errors", drawn(found.title, found.chart)
    yield "report_curves", last_lead(run)
    in_search = (block for block in search(run).blocks if isinstance(block, FigureBlock))
    for name, figure in (("shape", lead_shape(run)[0]), ("search", next(in_search))):
        yield f"report_{name}", drawn(figure.title, figure.chart)


def last_lead(run: ReportedRun) -> str:
    """The curves of the held-out experiment at the head of a report, or of the training one."""
    *_, figure = lead_figures(RecordCharts(run))
    return drawn(figure.title, figure.chart)


def drawn(title: str, chart: Chart) -> str:
    """A chart as a picture that needs no page around it."""
    height = AROUND + sum(plot.height + BETWEEN for plot in chart.plots)
    css = importlib.resources.files("cluster_est.html_report").joinpath("templates", "report.css")
    html = str(chart.html()).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ')
    return str(
        REPORT_PICTURE.format(
            width=REPORT_WIDTH,
            height=height,
            title=title,
            style=Markup(css.read_text(encoding="utf-8") + SHEET),
            chart=Markup(html),
        )
    )


def closed_loop(run: Path) -> str:
    """The picture of the README: a closed loop on data with a friction that nothing declares."""
    table = pq.read_table(run / "residuals.parquet")
    table = table.filter(pc.equal(table["experiment"], "exp4"))
    times, measured, after, before = (
        table[name].to_numpy() for name in ("time", "measured", "simulated", "simulated_before")
    )
    (effect,) = json.loads((run / "run.json").read_text(encoding="utf-8"))["effects"]
    values = ", ".join(
        f"{name} = {value['value']:.4g} {value['unit']}"
        for name, value in effect["parameters"].items()
    )
    span = (0.0, float(times[-1]))
    upper = Axes(70, 840, 84, 290, span, (-0.6, 0.6))
    lower = Axes(70, 840, 356, 456, span, (-0.15, 0.15))
    rms = [f"{np.sqrt(np.mean((measured - each) ** 2)):.4f}" for each in (before, after)]
    parts = [
        text(70, 28, f"found: {effect['equation']}", "head"),
        text(840, 28, values, "plain", anchor="end"),
        text(70, 58, "position in m, held-out experiment", "plain"),
        *legend(460, 58, {"thin c1": "fitted model", "thin c0": "with the effect"}, 134),
        *upper.rules((-0.5, 0.0, 0.5)),
        text(
            70,
            330,
            f"measured - simulated in m; root mean square {rms[0]} before, {rms[1]} after",
            "plain",
        ),
        *lower.rules((-0.1, 0.0, 0.1)),
        *record(upper, lower, times, measured, {"thin c1": before, "thin c0": after}),
        *lower.numbers(range(0, int(times[-1]) + 1, 2)),
        text(840, 492, "time in s", anchor="end"),
    ]
    return document((860, 500), f"Found: {effect['equation']}", RECORD_STYLE, parts)


@dataclass(frozen=True)
class Descent:
    """The best cost of a method after so many points, each simulated in every experiment."""

    method: str
    points: FloatArray
    cost: FloatArray


def read_descent(run: Path) -> Descent:
    """The search of a fit."""
    config = tomllib.loads((run / "config.toml").read_text(encoding="utf-8"))
    table = pq.read_table(run / "searches.parquet")
    table = table.filter(pc.equal(table["search"], "train"))
    cost = np.minimum.accumulate(table["cost"].to_numpy())
    return Descent(config["method"]["name"], table["evaluations"].to_numpy().astype(float), cost)


MOST, LEAST = 3, -4
"""Powers of ten of the cost above the lowest, over the lowest."""


def costs_of_methods(descents: Sequence[Descent]) -> str:
    """The descents of several methods, both axes logarithmic."""
    lowest = min(float(each.cost.min()) for each in descents)
    furthest = float(np.log10(max(float(each.points.max()) for each in descents)))
    axes = Axes(70, 700, 60, 340, (0.0, furthest), (float(LEAST), float(MOST)))
    parts = [
        text(70, 28, "cost above the lowest, over the lowest", "plain"),
        text(700, 386, "points, each simulated in every experiment", anchor="end"),
        text(706, 28, "points until 0.0001"),
        *axes.rules(range(LEAST, MOST + 1), lambda power: f"{10.0**power:g}"),
        *axes.numbers(range(int(furthest) + 1), lambda power: f"{10**power}"),
    ]
    for number, each in enumerate(sorted(descents, key=lambda d: d.points[-1])):
        above = np.log10(np.maximum(each.cost / lowest - 1.0, 10.0**LEAST))
        there = np.flatnonzero(above <= LEAST + 1e-9)
        end = int(there[0]) + 1 if len(there) else len(above)
        kind, at = f"line c{number}", 60 + 22 * number
        parts.append(axes.curve(np.log10(each.points[:end]), above[:end], kind))
        parts.append(f'<path class="{kind}" d="M706 {at - 5}h16"/>')
        parts.append(text(726, at, f"{each.method}: {each.points[end - 1]:.0f}"))
    title = "The cost over the simulations of five methods"
    return document((860, 400), title, "", parts)


if __name__ == "__main__":
    main()
