"""The page: sections from a run's folder, put into one HTML file that needs no network."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from cluster_est.errors import RunFolderError
from cluster_est.report.activity import LogActivity
from cluster_est.report.error_sizes import error_picture
from cluster_est.report.folder import ReportedRun, read_run
from cluster_est.report.sections.curves import curves
from cluster_est.report.sections.effects import candidates, effects
from cluster_est.report.sections.errors import errors
from cluster_est.report.sections.parameters import parameters
from cluster_est.report.sections.provenance import provenance
from cluster_est.report.sections.search import search
from cluster_est.report.sections.workers import workers
from cluster_est.report.summary import summarise

REPORT = "report.html"
SECTIONS = (errors, curves, effects, candidates, parameters, search, workers, provenance)
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
    if path.is_dir():
        raise RunFolderError(f"{path}: must be a file but is a folder; choose another --out")
    _replace(path, render(read_run(run_folder, activity), reload))
    return path


def _replace(path: Path, text: str) -> None:
    """Write a file in one step."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")  # others may write it too
    try:
        partial.write_text(text, encoding="utf-8", newline="\n")
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise RunFolderError(
            f"{path}: must be written but cannot be ({error}); make room, or choose another --out"
        ) from error


def render(run: ReportedRun, reload: float | None = None) -> str:
    """The page as text; the same run gives the same page."""
    sections = [section for make in SECTIONS if (section := make(run)).blocks]
    script = _asset("report.js")
    return _template().render(
        run=run,
        summary=summarise(run),
        picture=error_picture(run),
        sections=sections,
        style=Markup(_asset("report.css")),
        script=Markup(script),
        policy=_policy(script),
        reload=reload if run.is_running else None,
    )


def _policy(script: str) -> str:
    """Nothing may be fetched, and only this script may run."""
    return (
        f"default-src 'none'; script-src 'sha256-{_sha256(script)}'; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("cluster_est.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html")


def _asset(name: str) -> str:
    file = importlib.resources.files("cluster_est.report").joinpath("templates", name)
    return file.read_text(encoding="utf-8")
