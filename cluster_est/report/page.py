"""The page: sections from a run's folder, put into one HTML file that needs no network."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
import importlib.util
import os
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from cluster_est.errors import RunFolderError
from cluster_est.report.activity import LogActivity
from cluster_est.report.blocks import ExplorerBlock, FigureBlock, ReportSection
from cluster_est.report.encode import json_text
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
    scripts = {"plotly": _plotly(), "own": _asset("report.js")}
    return _template().render(
        run=run,
        summary=summarise(run),
        sections=sections,
        data=Markup(json_text(_data(sections))),
        style=Markup(_asset("report.css")),
        scripts={name: Markup(text) for name, text in scripts.items()},
        policy=_policy(scripts.values()),
        reload=reload if run.is_running else None,
    )


def _data(sections: Sequence[ReportSection]) -> dict[str, Any]:
    """Return the data that the page's script draws."""
    blocks = [block for section in sections for block in section.blocks]
    figures = {
        b.id: {"traces": b.traces, "layout": b.layout} for b in blocks if isinstance(b, FigureBlock)
    }
    explorers = [b.experiments for b in blocks if isinstance(b, ExplorerBlock)]
    return {"figures": figures, "experiments": explorers[0] if explorers else []}


def _policy(scripts: Any) -> str:
    """Nothing may be fetched, and only these scripts may run."""
    hashes = " ".join(f"'sha256-{_sha256(text)}'" for text in scripts)
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
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


@cache
def _plotly() -> str:
    """Plotly's script; found without importing its Python package, which takes long.

    Raises
    ------
    RunFolderError
        If it is not there.
    """
    found = importlib.util.find_spec("plotly")
    for folder in (found.submodule_search_locations if found is not None else None) or []:
        file = Path(folder) / "package_data" / "plotly.min.js"
        if file.is_file():
            text = file.read_text(encoding="utf-8").replace("\r\n", "\n").replace("\r", "\n")
            return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")
    raise RunFolderError(
        "report: needs the script of the package plotly, which is not installed whole; install it "
        "again: pip install --force-reinstall plotly"
    )
