"""The page: a summary in sentences and sections, made from a run's folder, as one HTML file."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from cluster_est.errors import RunFolderError
from cluster_est.html_report.activity import LogActivity
from cluster_est.html_report.curve_section import RecordCharts, curves
from cluster_est.html_report.design_section import design
from cluster_est.html_report.effect_sections import candidates, effects
from cluster_est.html_report.error_sections import errors
from cluster_est.html_report.first_screen import first_screen
from cluster_est.html_report.headline import summarise
from cluster_est.html_report.parameter_sections import parameters, sensitivity
from cluster_est.html_report.reported_run import ReportedRun, read_run
from cluster_est.html_report.residual_section import residuals
from cluster_est.html_report.search_sections import provenance, search, workers
from cluster_est.whole_files import ELSEWHERE, write_whole


def rendered(template: str, **values: Any) -> str:
    """Fill a template with values, and with the common style, script and policy."""
    script = _asset("report.js") + _asset("pictures.js")
    return (
        _environment()
        .get_template(template)
        .render(
            style=Markup(_asset("report.css")),
            script=Markup(script),
            policy=_policy(script),
            **values,
        )
    )


def write_page(path: Path, text: str) -> None:
    """Write a file atomically.

    Raises
    ------
    RunFolderError
        If the path is a folder or cannot be written.
    """
    if path.is_dir():
        raise RunFolderError(f"{path}: must be a file, but is a folder; choose another --out")
    write_whole(path, text.encode(), ELSEWHERE, shared=True)


def _policy(script: str) -> str:
    """Return a policy under which nothing is fetched, and only this script may run."""
    return (
        f"default-src 'none'; script-src 'sha256-{_sha256(script)}'; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("cluster_est.html_report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _asset(name: str) -> str:
    file = importlib.resources.files("cluster_est.html_report").joinpath("templates", name)
    return file.read_text(encoding="utf-8")


REPORT = "report.html"


def write_report(
    run_folder: Path,
    out: Path | None = None,
    *,
    reload: float | None = None,
    activity: LogActivity | None = None,
) -> Path:
    """Write the report of a run, atomically.

    Parameters
    ----------
    run_folder
        Folder of a run that is finished, interrupted or running.
    out
        The file to write; report.html in the folder if None.
    reload
        Seconds after which the page reloads itself while the run continues.
    activity
        Contents of its log, if already read.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    RunFolderError
        If there is no run, one of its tables is damaged, or the file cannot be written.
    """
    path = run_folder / REPORT if out is None else out
    # a page is opened anywhere, so its commands name the whole path
    write_page(path, render(read_run(run_folder.absolute(), activity), reload))
    return path


def render(run: ReportedRun, reload: float | None = None) -> str:
    """Return the page as text; the same run gives the same page."""
    charts = RecordCharts(run)
    records = charts.full()
    sections = (
        design(run), sensitivity(run), parameters(run), errors(run),
        curves(run, charts, tuple(records)), residuals(run), effects(run), candidates(run),
        search(run), workers(run), provenance(run),
    )  # fmt: skip
    return rendered(
        "report.html",
        run=run,
        summary=summarise(run),
        first=first_screen(run, charts),
        sections=[section for section in sections if section.blocks],
        records=list(records.values()),
        reload=reload if run.is_running else None,
    )
