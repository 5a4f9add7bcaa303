"""The verdict and what to know, in sentences."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cluster_est.report.blocks import Tone
from cluster_est.report.error_sizes import error_sentence, error_sizes
from cluster_est.report.folder import RUNNING, ReportedRun, Row
from cluster_est.report.numbers import count, digits, duration, percent
from cluster_est.run_folder.judgement import doubts_of, run_worth


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


GOING_ON = "The run goes on"
VERDICTS: dict[str, tuple[str, Tone]] = {
    "found": ("The missing effects were found", "good"),
    "partial": ("A part of what is missing was found", ""),
    "unexplained": ("Something is missing, and nothing explains it", "bad"),
    "none": ("Nothing is missing that these data show", "good"),
    "none (coloured noise)": ("What is left looks like coloured noise of a sensor", "good"),
    "done": ("The fit reached a solution", "good"),
    "not converged": ("The fit did not converge", "bad"),
    "interrupted": ("The run was interrupted", "bad"),
    "failed": ("The run failed", "bad"),
    RUNNING: (GOING_ON, ""),
}


def summarise(run: ReportedRun) -> ReportSummary:
    """Put the result of a run into words."""
    known = run.facts.get("verdict") or run.status
    verdict, tone = VERDICTS.get(str(known), (str(known), ""))
    if run.is_sensitivity:
        verdict, tone = "The parameters are ranked by what they move", ""
    if run.is_design:
        verdict, tone = "The next experiment", ""
    if run.finished and not (run.is_loop or run.is_sensitivity or run.is_design):
        doubts = doubts_of(run.facts)
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
        return ["Nothing moves the cost between the bounds of the parameters."]
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
        named = ", ".join(_named(effect) for effect in effects)
        added = f"Added to the model: {named}." if effects else "Nothing was added to the model."
        return [_sentence(facts.get("summary") or ""), added]
    if not run.finished:
        if run.is_running:
            return ["What follows is what its folder holds so far; results come when it ends."]
        message = facts.get("message") or ""
        return [_sentence(message), "It left no results; what its folder holds is shown."]
    message = facts.get("message") or ""
    ended = f"The search ended: {message}." if message else ""
    return [ended] if ended else []


def _named(effect: Row) -> str:
    if effect.get("words"):
        return f"{effect['words']} at {effect['site']}"
    of = ", ".join(effect.get("variables") or ())
    return f"{effect['form']}{' of ' + of if of else ''} at {effect['site']}"


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
        return ["There is no held-out experiment, so nothing tells how it predicts."]
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
    tried = run.facts.get("failures_in_search", 0)  # runs of earlier versions do not say
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
