"""The page: a head in sentences and sections, made of a run's folder, as one HTML file."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from cluster_est.errors import RunFolderError
from cluster_est.html_report.activity import LogActivity
from cluster_est.html_report.curve_section import curves
from cluster_est.html_report.design_section import design
from cluster_est.html_report.effect_sections import candidates, effects
from cluster_est.html_report.error_sections import (
    error_picture,
    error_sentence,
    error_sizes,
    errors,
)
from cluster_est.html_report.number_text import count, digits, duration, percent
from cluster_est.html_report.page_blocks import Tone
from cluster_est.html_report.parameter_sections import parameters, sensitivity
from cluster_est.html_report.reported_run import ReportedRun, read_run
from cluster_est.html_report.search_sections import provenance, search, workers
from cluster_est.run_folder.run_files import RunStatus, run_worth
from cluster_est.whole_files import ELSEWHERE, write_whole


def rendered(template: str, **values: Any) -> str:
    """Fill a template, with the style, the script and the policy that every page has."""
    script = _asset("report.js")
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
    """Write a file in one step.

    Raises
    ------
    RunFolderError
        If it is a folder or cannot be written.
    """
    if path.is_dir():
        raise RunFolderError(f"{path}: must be a file but is a folder; choose another --out")
    write_whole(path, text.encode(), ELSEWHERE, shared=True)


def _policy(script: str) -> str:
    """Nothing may be fetched, and only this script may run."""
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
SECTIONS = (
    design, sensitivity, errors, curves, effects, candidates, parameters, search, workers,
    provenance,
)  # fmt: skip
"""The sections of a page, in their order."""


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


@dataclass(frozen=True)
class HeadlineFigure:
    """A number at the top of the page, with what it is."""

    label: str
    value: str
    more: str = ""


@dataclass(frozen=True)
class ReportSummary:
    """The head of the page: verdict, sentences, figures and notes."""

    verdict: str
    tone: Tone
    sentences: tuple[str, ...]
    figures: tuple[HeadlineFigure, ...]
    notes: tuple[str, ...]


VERDICTS: dict[str, tuple[str, Tone]] = {
    "found": ("The missing effects were found", "good"),
    "partial": ("A part of what is missing was found", ""),
    "unexplained": ("Something is missing, and nothing explains it", "bad"),
    "none": ("These data do not show that anything is missing", "good"),
    "none (coloured noise)": ("The remaining residual looks like coloured sensor noise", "good"),
    "done": ("The fit reached a solution", "good"),
    "not converged": ("The fit did not converge", "bad"),
    "interrupted": ("The run was interrupted", "bad"),
    "failed": ("The run failed", "bad"),
    RunStatus.RUNNING: ("The run goes on", ""),
}


def summarise(run: ReportedRun) -> ReportSummary:
    """Put the result of a run into words."""
    known = run.facts.get("verdict") or run.status
    verdict, tone = VERDICTS.get(str(known), (str(known), ""))
    if run.is_sensitivity:
        verdict, tone = "The parameters are ranked by their influence", ""
    if run.is_design:
        verdict, tone = "The next experiment", ""
    if run.finished and not (run.is_loop or run.is_sensitivity or run.is_design):
        doubts = run.facts.get("doubts") or ()
        verdict, tone = "; ".join([verdict, *doubts]), run_worth(run.status, doubts).value
    sentences = [
        *_fitted(run), *_ranked(run), *_opening(run), *_costs(run), *_errors(run), *_bounds(run),
        *_failed(run),
    ]  # fmt: skip
    said = run.facts.get("notes") or ()
    notes = tuple(_sentence(note) for note in said[1 if run.is_design else 0 :])
    return ReportSummary(verdict, tone, tuple(sentences), _figures(run), notes)


def _fitted(run: ReportedRun) -> list[str]:
    """Return sentences on what was fitted to what, and how the error went."""
    if not run.finished:
        return []
    numbers = sum(row["estimated_on"] == "train" for row in run.tables["parameters"])
    roles = {row["experiment"]: row["role"] for row in run.tables["errors"]}
    train = sum(role == "train" for role in roles.values())
    model = (run.facts.get("fmu") or {}).get("name") or "the model"
    were = "parameter value of" if numbers == 1 else "parameter values of"
    said = f"{numbers} {were} {model} {'was' if numbers == 1 else 'were'} fitted to {train} "
    said += "experiment." if train == 1 else "experiments."
    return [said, *filter(None, [error_sentence(run)])]


def _ranked(run: ReportedRun) -> list[str]:
    """Return sentences on what a sensitivity analysis ranks first, and what goes together."""
    if not run.is_sensitivity:
        return []
    rows = [row for row in run.tables["ranking"] if row["value"] is not None]
    known = [row["label"] for row in rows if math.isfinite(row["value"]) and row["value"] > 0.0]
    if not known:
        return ["No parameter changes the cost within its bounds."]
    of_all, together = len(run.tables["ranking"]), run.facts["sensitivity"]["together"]
    said = [f"The cost depends on {known[0]}."]
    if of_all > 1:
        then = f", then {' and '.join(known[1:3])}" if known[1:] else ""
        said = [f"Of {of_all} unknowns, {known[0]} matters most for the cost{then}."]
    if together:
        how_many = "all" if len(together) == of_all else str(len(together))
        if of_all > 1:
            said.append(f"At the start values {how_many} of them can be estimated together.")
    return said


def _opening(run: ReportedRun) -> list[str]:
    facts = run.facts
    if run.is_sensitivity:
        return []
    if run.is_design:
        return [_sentence(facts["design"]["summary"])]
    if run.is_loop:
        effects = facts.get("effects") or []
        named = ", ".join(f"{effect['words']} at {effect['site']}" for effect in effects)
        added = f"Added to the model: {named}." if effects else "Nothing was added to the model."
        return [_sentence(facts.get("summary") or ""), added]
    if not run.finished:
        if run.is_running:
            return [
                "This page shows the current content of its folder; results follow when it ends."
            ]
        message = facts.get("message") or ""
        return [
            _sentence(message),
            "It left no results; this page shows the content of its folder.",
        ]
    message = facts.get("message") or ""
    ended = f"The search ended: {message}." if message else ""
    return [ended] if ended else []


def _costs(run: ReportedRun) -> list[str]:
    before, after = run.facts.get("cost_before"), run.facts.get("cost")
    if before is None or after is None:
        if run.finished:
            return ["The cost is not known before and after, because a simulation failed."]
        return []
    what = "from the declared model, fitted," if run.is_loop else "from the start values"
    if not before:
        return [f"The cost was 0 {what} and is {digits(after)}."]
    share = after / before
    if share < 0.01:
        return [f"The cost fell {what} by a factor of {digits(before / max(after, 1e-300), 3)}."]
    if share == 1.0:
        then = "with the declared model, fitted" if run.is_loop else "at the start values"
        return [f"The cost is {digits(after)}, as it was {then}."]
    moved = "fell" if share < 1.0 else "rose"
    return [f"The cost {moved} {what} by {percent(abs(1.0 - share))}."]


def _errors(run: ReportedRun) -> list[str]:
    """Return a sentence where nothing was held out."""
    held_out = any(row["role"] == "test" for row in run.tables["errors"])
    if run.finished and not held_out:
        return ["There is no held-out experiment, so its predictions were not tested."]
    return []


def _bounds(run: ReportedRun) -> list[str]:
    held = [row["label"] for row in run.tables["parameters"] if row["at_bound"]]
    if not held:
        return []
    if len(held) == 1:
        return [f"{held[0]} stands at a bound."]
    names = ", ".join(held[:5]) + (", …" if len(held) > 5 else "")
    return [f"{len(held)} parameters stand at a bound: {names}."]


def _simulated(run: ReportedRun) -> tuple[int, int]:
    """Simulations and failures by the log, or by run.json of a run that was saved without one."""
    if run.activity.simulations:
        return run.activity.simulations, sum(each.count for each in run.activity.failures)
    return int(run.facts.get("simulations") or 0), int(run.facts.get("failures") or 0)


def _failed(run: ReportedRun) -> list[str]:
    total, failures = _simulated(run)
    if not failures:
        return []
    total = max(total, 1)
    share = "less than 0.1\u2009%" if failures / total < 1e-3 else percent(failures / total)
    tried = run.facts.get("failures_in_search", 0)
    which = "all" if tried == failures else count(tried)
    of = f", {which} of them while effects were tried" if tried else ""
    return [f"{count(failures)} of {count(total)} simulations failed ({share}){of}."]


def _figures(run: ReportedRun) -> tuple[HeadlineFigure, ...]:
    facts = run.facts
    found = []
    if facts.get("cost") is not None:
        found.append(
            HeadlineFigure("Cost", digits(facts["cost"]), f"before {digits(facts['cost_before'])}")
        )
    sizes = error_sizes(run)
    for role, label in (("train", "Error, training"), ("test", "Error, held out")):
        chosen = sizes.of_role(role)
        after = sizes.of(chosen, "after")
        if not math.isnan(after):
            before = digits(sizes.of(chosen, "before"), 3)
            found.append(
                HeadlineFigure(label, digits(after, 3), f"before {before}, over {sizes.measure}")
            )
    simulations, failures = _simulated(run)
    if simulations:
        more = f"{count(failures)} failed" if failures else "none failed"
        found.append(HeadlineFigure("Simulations", count(simulations), more))
    if facts.get("seconds") is not None:
        workers = len(run.tables["workers"]) or 1
        more = f"{workers} worker{'s' if workers > 1 else ''}"
        found.append(HeadlineFigure("Time", duration(facts["seconds"]), more))
    return tuple(found)


def _sentence(text: str) -> str:
    """With a capital and a full stop."""
    text = text.strip()
    if not text:
        return ""
    text = text[0].upper() + text[1:] if text.split()[0].isalpha() else text
    return text if text[-1] in ".!?" else f"{text}."
