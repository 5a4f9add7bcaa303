"""The page: sections from a run's folder, put into one HTML file that needs no network."""

from __future__ import annotations

from pathlib import Path

from cluster_est.report.activity import LogActivity
from cluster_est.report.error_sizes import error_picture
from cluster_est.report.folder import ReportedRun, read_run
from cluster_est.report.html_file import rendered, write_page
from cluster_est.report.sections.curves import curves
from cluster_est.report.sections.design import design
from cluster_est.report.sections.effects import candidates, effects
from cluster_est.report.sections.errors import errors
from cluster_est.report.sections.parameters import parameters
from cluster_est.report.sections.search import search
from cluster_est.report.sections.sensitivity import sensitivity
from cluster_est.report.sections.workers import provenance, workers
from cluster_est.report.summary import summarise

REPORT = "report.html"
SECTIONS = (
    design, sensitivity, errors, curves, effects, candidates, parameters, search, workers,
    provenance,
)  # fmt: skip
"""In the order of the page."""


def write_report(
    run_folder: Path,
    out: Path | None = None,
    *,
    reload: float | None = None,
    activity: LogActivity | None = None,
) -> Path:
    """Write the report of a run, in one step.

    Parameters
    ----------
    run_folder
        Of a run that is finished, interrupted or still going on.
    out
        The file to write; report.html in the folder if None.
    reload
        Seconds after which the page loads itself again, while the run goes on.
    activity
        What its log says, where that has been read already.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    RunFolderError
        If there is no run, one of its tables is damaged, or the file cannot be written.
    """
    path = run_folder / REPORT if out is None else out
    write_page(path, render(read_run(run_folder, activity), reload))
    return path


def render(run: ReportedRun, reload: float | None = None) -> str:
    """The page as text; the same run gives the same page."""
    return rendered(
        "report.html",
        run=run,
        summary=summarise(run),
        picture=error_picture(run),
        sections=[section for make in SECTIONS if (section := make(run)).blocks],
        reload=reload if run.is_running else None,
    )
