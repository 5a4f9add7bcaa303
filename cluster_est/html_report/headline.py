"""The result of a run in words: a headline, a few sentences, and next steps."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cluster_est.html_report.error_sections import error_sentence, error_sizes
from cluster_est.html_report.number_text import count, percent
from cluster_est.html_report.page_blocks import NextStep, Tone
from cluster_est.html_report.reported_run import ReportedRun, Row, other_laws
from cluster_est.problem.display import in_a_row
from cluster_est.run_folder.run_files import RunStatus, run_worth


@dataclass(frozen=True)
class ReportSummary:
    """The texts at the head of the page: verdict, sentences, next steps and notes."""

    verdict: str
    tone: Tone
    sentences: tuple[str, ...]
    steps: tuple[NextStep, ...]
    notes: tuple[str, ...]


LOOP_VERDICTS: dict[str, tuple[str, Tone]] = {
    "found": ("Found", "good"),
    "partial": ("Found in part", ""),
    "unexplained": ("Something is missing, and no effect explains it", "bad"),
    "none": ("These data do not show that anything is missing", "good"),
    "none (coloured noise)": ("The remaining error looks like coloured sensor noise", "good"),
}
FIT_VERDICTS = {"done": "Fitted", "not converged": "The fit did not converge"}
ENDINGS: dict[str, tuple[str, Tone]] = {
    "interrupted": ("The run was interrupted", "bad"),
    "failed": ("The run failed", "bad"),
    RunStatus.RUNNING: ("The run is in progress", ""),
}
NEAR_NOISE = 1.5
"""Ratio of error to noise up to which a fit follows the data as well as the noise allows."""


def summarise(run: ReportedRun) -> ReportSummary:
    """Return a summary of the result of a run in words."""
    verdict, tone = _verdict(run)
    sentences = [*_opening(run), *_fitted(run), *_bounds(run), *_failed(run)]
    said = run.facts.get("notes") or ()
    notes = tuple(_sentence(note) for note in said[1 if run.is_design else 0 :])
    return ReportSummary(verdict, tone, tuple(sentences), next_steps(run), notes)


def _verdict(run: ReportedRun) -> tuple[str, Tone]:
    if run.is_sensitivity:
        return _ranked(run), ""
    if run.is_design:
        return _designed(run), ""
    if run.is_loop:
        verdict, tone = LOOP_VERDICTS.get(run.facts["verdict"], (run.facts["verdict"], ""))
        named = " and ".join(map(_named, run.facts["effects"] or ()))
        return f"{verdict}: {named}" if named else _with_errors(run, verdict), tone
    if not run.finished or run.status in ENDINGS:
        return ENDINGS.get(run.status, (run.status, ""))
    doubts = run.facts.get("doubts") or ()
    verdict = FIT_VERDICTS.get(run.status, run.status)
    if run.status == RunStatus.DONE:
        verdict += ", but doubtful" if doubts else " to the noise" if _is_near_noise(run) else ""
    return _with_errors(run, verdict), run_worth(run.status, doubts).value


def _named(effect: Row) -> str:
    lead = "" if effect.get("claimed", True) else " (a lead)"
    return f"{effect['words']} at {effect['site']}{lead}"


def _is_near_noise(run: ReportedRun) -> bool:
    sizes = error_sizes(run)
    every = [sizes.of(sizes.of_role(role), "after") for role in ("train", "test")]
    known = [size for size in every if not math.isnan(size)]
    return sizes.is_noise and bool(known) and max(known) <= NEAR_NOISE


def _with_errors(run: ReportedRun, verdict: str) -> str:
    """Return a verdict with the errors of training and of held-out experiments."""
    sizes = error_sizes(run)
    train, test = (sizes.said(sizes.of_role(role)) for role in ("train", "test"))
    of = " the noise" if sizes.is_noise else " of the signal"  # not repeated for held-out errors
    held_out = f"held out {test.removeprefix('error ').removesuffix(of)}" if test else ""
    said = "; ".join(filter(None, [train, held_out]))
    return f"{verdict}: {said}" if said else verdict


def _ranked(run: ReportedRun) -> str:
    """Return the parameter that a sensitivity analysis ranks first."""
    rows = [row for row in run.tables["ranking"] if row["value"] is not None]
    known = [row["label"] for row in rows if math.isfinite(row["value"]) and row["value"] > 0.0]
    if not known:
        return "No parameter changes the cost within its bounds"
    if len(run.tables["ranking"]) == 1:
        return f"The cost depends on {known[0]}"
    then = f", then {' and '.join(known[1:3])}" if known[1:] else ""
    return f"The cost depends most on {known[0]}{then}"


def _designed(run: ReportedRun) -> str:
    """Return the expected result of the next experiment in a few words."""
    design = run.facts["design"]
    said = f"The next experiment: {design['waveform']}, {design['duration']:.4g} s"
    rows = [row for row in run.tables["probabilities"] if not math.isnan(row["after"])]
    if rows:
        told = sum(row["after"] > max(LIKELY, row["before"]) for row in rows)
        if not told:
            return f"{said}; it is not expected to distinguish any model from its rivals"
        return (
            f"{said}; it is expected to distinguish {told} of {len(rows)} models from their "
            "rivals, if that model is the right one"
        )
    before, after = "std_error_before", "std_error_after"
    of_all = run.tables["prediction_precision"] or run.tables["precision"]
    rows = [row for row in of_all if row[before] > 0.0 and row[after] >= 0.0]
    if not rows:
        return said
    best = min(rows, key=lambda row: row[after] / row[before])
    share, name = best[after] / best[before], best.get("label") or best["output"]
    what = "predicted " if "output" in best else ""
    return (
        f"{said}; the standard error of {what}{name} should fall to {percent(share)} of its "
        "present value"
    )


LIKELY = 0.9
"""Probability from which a model counts as distinguished from its rivals."""


def _fitted(run: ReportedRun) -> list[str]:
    """Return sentences on doubts, on the fitted data, and on the change of the error."""
    if not run.finished:
        return []
    doubts = [] if run.is_loop else [_sentence(each) for each in run.facts.get("doubts") or ()]
    numbers = sum(row["estimated_on"] == "train" for row in run.tables["parameters"])
    roles = {row["experiment"]: row["role"] for row in run.tables["errors"]}
    train = sum(role == "train" for role in roles.values())
    model = (run.facts.get("fmu") or {}).get("name") or "the model"
    were = "parameter value of" if numbers == 1 else "parameter values of"
    said = f"{numbers} {were} {model} {'was' if numbers == 1 else 'were'} fitted to {train} "
    said += "experiment." if train == 1 else "experiments."
    held_out = [] if "test" in roles.values() else [NOT_HELD_OUT]
    error = "" if run.facts.get("summary") else error_sentence(run)
    return [*doubts, said, *filter(None, [error]), *held_out]


NOT_HELD_OUT = "No experiment is held out, so it is not known how well the model predicts."


def _opening(run: ReportedRun) -> list[str]:
    """Return the first sentences about a run."""
    facts = run.facts
    if run.is_sensitivity:
        of_all, together = len(run.tables["ranking"]), facts["sensitivity"]["together"]
        how_many = "all" if len(together) == of_all else str(len(together))
        said = f"At the start values, {how_many} of {of_all} unknowns can be estimated together."
        return [said] if together and of_all > 1 else []
    if run.is_design:
        how, _, expected = facts["design"]["summary"].partition(": ")  # the headline has it
        return [_sentence(expected or how)]
    if run.is_loop:
        added = [] if facts.get("effects") else ["Nothing was added to the model."]
        return [_sentence(facts.get("summary") or ""), *added]
    if run.finished:
        return []
    if run.is_running:
        return ["This page shows what the run has written so far; the results follow when it ends."]
    return [
        _sentence(facts.get("message") or ""),
        "The run left no results; this page shows what is in its folder.",
    ]


def _bounds(run: ReportedRun) -> list[str]:
    held = _at_bounds(run)
    if not held:
        return []
    if len(held) == 1:
        return [f"{held[0]} is at a bound."]
    return [f"{len(held)} parameters are at a bound: {_listed(held)}."]


def _at_bounds(run: ReportedRun) -> list[str]:
    return [row["label"] for row in run.tables["parameters"] if row["at_bound"]]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", …" if len(names) > 5 else "")


def _failed(run: ReportedRun) -> list[str]:
    total, failures = run.simulated
    tried = run.facts.get("failures_in_search", 0)
    if not failures or tried == failures:  # the section on workers contains it
        return []
    total = max(total, 1)
    share = "less than 0.1\u2009%" if failures / total < 1e-3 else percent(failures / total)
    of = f", {count(tried)} of them in the search for effects" if tried else ""
    return [f"{count(failures)} of {count(total)} simulations failed ({share}){of}."]


LIMITS = "limits.toml"
"""Name of the file of limits, which the user has to write."""


def command(name: str, *given: str | Path) -> str:
    """Return a command that can be pasted into a shell."""
    return shlex.join(["cluster-est", name, *map(str, given)])


LOOK = (
    "Look for the places with the largest remaining error, and declare an equation of your own "
    "there ([[effects]]); if closed_loop.effects or closed_loop.sites leave something out, allow "
    "it."
)


def next_steps(run: ReportedRun) -> tuple[NextStep, ...]:
    """Return next steps with their commands, the most important first."""
    return tuple(_steps(run))


def _steps(run: ReportedRun) -> Iterator[NextStep]:
    if run.is_design:
        yield _measure(run)
    elif run.is_sensitivity:
        fit = _with_config(run, "fit")
        yield NextStep("Fit the influential parameters, and fix the others.", fit)
    if not run.finished:
        return
    if first := run.facts.get("first"):  # until then, other steps would start from wrong results
        yield NextStep(f"{first[:1].upper()}{first[1:]} as the summary says, and search again.")
    else:
        yield from _after_run(run)
    if not any(row["role"] == "test" for row in run.tables["errors"]):
        yield NextStep('Hold an experiment out (role = "test") to see how well the model predicts.')


def _after_run(run: ReportedRun) -> Iterator[NextStep]:
    if run.status == RunStatus.NOT_CONVERGED:
        yield NextStep("Give the fit a larger budget, another method, or several starts.")
    coefficients = tuple(f"{lead['name']}." for lead in _leads(run))
    # the law of a lead is uncertain, so wider bounds of its coefficients would not help
    if held := [label for label in _at_bounds(run) if not label.startswith(coefficients)]:
        yield NextStep(f"Widen the bounds of {_listed(held)}, or fix the values if they are known.")
    yield from _after_loop(run) if run.is_loop else _after_fit(run)


def _leads(run: ReportedRun) -> list[Row]:
    """Return the added effects that are only leads."""
    return [e for e in run.facts.get("effects") or [] if not e.get("claimed", True)]


def _label(effect: Row) -> str:
    """Return the form of an effect, its arguments unless they are the site's own, and its site."""
    form, site, of = effect["form"], effect["site"], ", ".join(effect["variables"])
    own = site in (f"der({of})", f"input {of}", f"output {of}")
    return f"{form} at {site}" if own or not of else f"{form}({of}) at {site}"


def _after_loop(run: ReportedRun) -> Iterator[NextStep]:
    effects: list[Row] = run.facts.get("effects") or []
    leads = _leads(run)
    if leads:
        named = in_a_row([_label(each) for each in leads])
        it = "it: it is only a lead" if len(leads) == 1 else "them: they are only leads"
        yield NextStep(f"Check {named} by a test or an inspection before you rely on {it}.")
    if len(leads) < len(effects):
        yield NextStep("Export the repaired model.", _export(run, "repaired.fmu"))
    if any(other_laws(effect) for effect in effects):
        yield _design(run, "Distinguish the effect from its rivals with another experiment")
    verdict = run.facts["verdict"]
    if verdict == "unexplained" or (verdict == "partial" and not _is_near_noise(run)):
        yield NextStep(LOOK)
    elif not effects:
        yield NextStep("Export the fitted model.", _export(run, "fitted.fmu"))


def _after_fit(run: ReportedRun) -> Iterator[NextStep]:
    if run.too_narrow:
        yield NextStep("See what the model lacks.", _with_config(run, "close-loop"))
    if run.tables["directions"]:
        yield _design(run, "Determine the other parameters with another experiment")
    if run.status == RunStatus.DONE and not run.facts.get("doubts"):
        yield NextStep("Export the fitted model.", _export(run, "fitted.fmu"))


def _with_config(run: ReportedRun, name: str) -> str:
    """Return a command for the config of a run; "" for a run from Python, which has none."""
    if run.config.startswith("# saved from Python"):
        return ""
    return command(name, run.path / "config.toml", "--out", run.beside(_suffix(name)))


def _suffix(name: str) -> str:
    """Return the suffix of the folder that a command writes."""
    return f"-{name.removeprefix('close-')}"


def _export(run: ReportedRun, fmu: str) -> str:
    return command("export", run.path, "--fmu", fmu)


def _design(run: ReportedRun, purpose: str) -> NextStep:
    text = f"{purpose} (first write its limits into {LIMITS})."
    return NextStep(text, command("design", run.path, "--limits", LIMITS, "--out", "next.csv"))


def _measure(run: ReportedRun) -> NextStep:
    """Return the step after a design: its experiment, and the study of all experiments."""
    table, config = run.beside(".csv"), run.facts.get("config_file")
    again = "close-loop" if run.facts["design"].get("criterion") == "discriminate" else "fit"
    said = (
        f"Run the experiment with the input in {table}, write the measurements into the empty "
        f"columns of this table, add the experiment to {config or 'the config'}, and fit again."
    )
    then = command(again, config, "--out", run.beside(_suffix(again))) if config else ""
    return NextStep(said, then)


def _sentence(text: str) -> str:
    """Return a text with a capital letter and a full stop."""
    text = text.strip()
    if not text:
        return ""
    text = text[0].upper() + text[1:] if text.split()[0].isalpha() else text
    return text if text[-1] in ".!?" else f"{text}."
