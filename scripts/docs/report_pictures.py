"""Draw the pictures of the docs: parts of reports, each as an SVG file of its own.

    cluster-est close-loop configs/mass_with_friction.toml --out runs/friction
    cluster-est fit configs/mass_spring_damper.toml --out runs/spring
    cluster-est sensitivity configs/mass_with_friction.toml --out runs/ranked
    cluster-est sweep configs/sweep.toml --out runs/sweep
    cluster-est design runs/friction --limits configs/mass_with_friction_limits.toml --out next.csv
    python scripts/docs/report_pictures.py runs/friction runs/spring runs/ranked runs/sweep next

Writes cluster_est/docs/*.svg from the tables of those runs, with the reports' own charts and
colours, for a light and for a dark page.
"""

from __future__ import annotations

import argparse
import importlib.resources
from collections.abc import Iterator
from pathlib import Path

from markupsafe import Markup

from cluster_est.report.charts import Chart
from cluster_est.report.curve_section import curves
from cluster_est.report.design_section import design
from cluster_est.report.effect_sections import effects
from cluster_est.report.error_sections import error_picture
from cluster_est.report.page_blocks import FigureBlock, PanelsBlock, ReportSection
from cluster_est.report.parameter_sections import sensitivity
from cluster_est.report.reported_run import ReportedRun, read_run
from cluster_est.report.search_sections import search
from cluster_est.report.sweep_page import SUMMARY, errors, is_sweep
from cluster_est.run_folder.run_files import read_run_table

DOCS = Path(__file__).resolve().parents[2] / "cluster_est" / "docs"
WIDTH = 820
AROUND = 92
"""Pixels of a chart besides its plots: title, legend, and what is written below."""
BETWEEN = 50
"""Pixels above and below each plot."""

PICTURE = Markup(
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
    for folder in parser.parse_args().runs:
        for name, text in pictures(folder):
            path = DOCS / f"{name}.svg"
            path.write_text(text, encoding="utf-8")
            print(path.name, f"{len(text) / 1e3:.0f} kB")


def pictures(folder: Path) -> Iterator[tuple[str, str]]:
    """The name and the text of each picture of a run."""
    if is_sweep(folder):
        figure = first_figure(errors(read_run_table(folder / SUMMARY)))
        yield "sweep_errors", drawn(figure.title, figure.chart)
        return
    run = read_run(folder)
    if run.is_sensitivity:
        figure = first_figure(sensitivity(run))
        yield "sensitivity_ranking", drawn(figure.title, figure.chart)
    elif run.is_design:
        yield "next_experiment", of_design(run)
    elif run.is_loop:
        yield from of_closed_loop(run)
    else:
        yield "first_fit", first_panel(run)


def of_design(run: ReportedRun) -> str:
    """The input, and what each model predicts of it, in one picture."""
    plots = [
        plot
        for block in design(run).blocks
        if isinstance(block, FigureBlock)
        for plot in block.chart.plots
    ]
    return drawn("The next experiment", Chart(tuple(plots), "time in s"))


def of_closed_loop(run: ReportedRun) -> Iterator[tuple[str, str]]:
    """The pictures of the page on the report."""
    found = error_picture(run)
    if found is not None:
        yield "report_errors", drawn(found.title, found.chart)
    yield "report_curves", first_panel(run)
    for name, section in (("shape", effects(run)), ("search", search(run))):
        figure = first_figure(section)
        yield f"report_{name}", drawn(figure.title, figure.chart)


def first_panel(run: ReportedRun) -> str:
    """The curves of the experiment that a report opens on."""
    panels = next(block for block in curves(run).blocks if isinstance(block, PanelsBlock)).panels
    panel = next(panel for panel in panels if panel.first)
    return drawn(f"{panel.experiment}, {panel.output}: {panel.note}", panel.chart)


def first_figure(section: ReportSection) -> FigureBlock:
    """The first chart of a section."""
    return next(block for block in section.blocks if isinstance(block, FigureBlock))


def drawn(title: str, chart: Chart) -> str:
    """A chart as a picture that needs no page around it."""
    height = AROUND + sum(plot.height + BETWEEN for plot in chart.plots)
    css = importlib.resources.files("cluster_est.report").joinpath("templates", "report.css")
    html = str(chart.html()).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ')
    return str(
        PICTURE.format(
            width=WIDTH,
            height=height,
            title=title,
            style=Markup(css.read_text(encoding="utf-8") + SHEET),
            chart=Markup(html),
        )
    )


if __name__ == "__main__":
    main()
