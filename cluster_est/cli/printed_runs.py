"""A run of any kind in a terminal: a fit, a closed loop, a sensitivity analysis, a design."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cluster_est.cli.answer import Answer, Cell
from cluster_est.cli.document import run_fields
from cluster_est.cli.printing import (
    SHOWN,
    at_bound,
    interval,
    number,
    numbers,
    print_run,
)
from cluster_est.experiment_design.design_sentences import times
from cluster_est.html_report.headline import next_steps
from cluster_est.html_report.reported_run import other_laws, read_results
from cluster_est.problem.display import BETTER, NO_ALTERNATIVE, SAME_PREDICTION, percent
from cluster_est.run_folder.run_files import Rows, StoredRun, read_stored_run


def print_design(answer: Answer, run: StoredRun) -> None:
    """Print the chosen input and the expected information of the experiment.

    `run` has the tables "probabilities", "evidence", "precision" and
    "prediction_precision".
    """
    facts = run.facts
    answer.tell(f"next experiment: {facts['design']['summary']}")
    answer.say(
        f"run {run.path}: {facts['simulations']} simulations ({facts['failures']} failed), "
        f"{facts['seconds']:.1f} s",
    )
    models = run.tables["probabilities"]
    if models:
        answer.rows(
            models,
            ("if this model is right, its probability", "model"),
            ("now", _percents("before")),
            ("after it", _percents("after")),
            ("after a random input", _percents("random")),
        )
        first = models[0]["model"]
        answer.rows(
            [row for row in run.tables["evidence"] if row["true_model"] == first],
            (f"rival of {first}", "rival"),
            ("expected to be less likely by", lambda row: times(row["evidence"])),
            ("after a random input", lambda row: times(row["random"])),
        )
    then = (
        ("after it", numbers("std_error_after", "")),
        ("after a random input", numbers("random", "")),
    )
    answer.rows(
        run.tables["precision"],
        ("parameter", "label"),
        ("unit", "unit"),
        ("value", numbers("value", "")),
        ("std error now", numbers("std_error_before", "")),
        *then,
    )
    if run.tables["prediction_precision"]:
        answer.rows(
            run.tables["prediction_precision"],
            ("predicted", "output"),
            ("of", "experiment"),
            ("unit", "unit"),
            ("std deviation now", numbers("std_error_before", "")),
            *then,
        )
    for note in facts["notes"][1:]:
        answer.say(f"note: {note}")
    answer.say(f"tables: {run.path}/*.parquet")


def _percents(key: str) -> Cell:
    return lambda row: "" if math.isnan(row[key]) else percent(row[key])


def print_sensitivity(answer: Answer, run: StoredRun) -> None:
    """Print the ranking of the unknowns, those that can be estimated together, and notes.

    `run` has the table "ranking".
    """
    facts = run.facts
    found = facts["sensitivity"]
    answer.say(
        f"run {run.path}: {found['method']}, {found['groups']} groups of points, "
        f"{facts['simulations']} simulations ({facts['failures']} failed), "
        f"{facts['seconds']:.1f} s",
    )
    answer.rows(
        run.tables["ranking"],
        ("parameter", "label"),
        (found["ranks"], numbers("value", "none")),
        ("+-", numbers("half_width", "")),
        ("seen, in sigmas", numbers("size", "")),
        ("collinearity", lambda row: _index(row["collinearity"])),
        ("estimate", lambda row: _together(row["position"], row["together"])),
    )
    for note in facts.get("notes") or []:
        answer.say(f"note: {note}")
    answer.say(f"tables: {run.path}/*.parquet")


def _index(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return UNKNOWN_NUMBER if math.isinf(value) else f"{value:.3g}"


def _together(position: int, together: bool) -> str:
    """Return the position in the order of estimation, if known."""
    if position < 0:
        return ""
    return f"{position + 1}." if together else "no"


Facts = Mapping[str, Any]

UNKNOWN_NUMBER = "unknown"


def print_any_run(answer: Answer, run_folder: Path) -> None:
    """Print a run of any kind.

    Raises
    ------
    RunFolderError
        If there is no run.
    """
    run = read_stored_run(run_folder, SHOWN)
    answer.add(**run_fields(run))
    if run.facts.get("sensitivity"):
        print_sensitivity(answer, run)
    elif run.facts.get("design"):
        print_design(answer, run)
    elif run.facts.get("verdict"):
        print_loop(answer, run)
    else:
        print_run(answer, run)
    _print_steps(answer, run_folder)


def _print_steps(answer: Answer, run_folder: Path) -> None:
    """Print what to do next, with commands that name this run."""
    steps = next_steps(read_results(run_folder))
    answer.add(next=[{"text": step.text, "command": step.command} for step in steps])
    for step in steps:
        answer.tell(f"next: {step.text}")
        if step.command:
            answer.say(f"  {step.command}")


def print_loop(answer: Answer, run: StoredRun) -> None:
    """Print verdict, effects, parameters, errors before and after, and notes."""
    facts = run.facts
    answer.tell(f"verdict: {facts['verdict']}: {facts['summary']}")
    answer.say(
        f"run {run.path}: {facts['simulations']} simulations ({_failed(facts)}), "
        f"{facts['seconds']:.1f} s",
    )
    narrow = facts["verdict"] == "unexplained"  # they do not include the missing effects
    for effect in facts["effects"]:
        _print_effect(answer, effect, too_narrow=narrow)
    choices = [facts[key] for key in ("likely", "resampled") if facts.get(key)]
    for said in ["", *choices] if choices else []:
        answer.tell(said)
    _print_parameters(answer, run.tables["parameters"], too_narrow=narrow)
    _print_errors(answer, run.tables["errors"], facts)
    for note in facts["notes"]:
        answer.say(f"note: {note}")
    _print_rest(answer, facts, run.tables["errors"])
    if facts["effects"]:
        answer.say("")
        answer.say("to add the effects to the config, so that cluster-est fit estimates them:")
        answer.say("")
        answer.say("\n".join(effect["config"] for effect in facts["effects"]))
    answer.say(f"tables: {run.path}/*.parquet")


def _failed(facts: Facts) -> str:
    """Return the number of failed simulations, and how many of these had only tested effects."""
    failed, tried = facts["failures"], facts["failures_in_search"]
    if not tried:
        return f"{failed} failed"
    which = "all" if tried == failed else str(tried)
    return f"{failed} failed, {which} of them in the search for effects"


def _print_effect(answer: Answer, effect: Facts, *, too_narrow: bool) -> None:
    answer.say("")
    kind = "effect" if effect.get("claimed", True) else "lead"
    answer.say(f"{kind} {effect['name']} ({effect['words']}) at {effect['site']}")
    answer.tell(f"  {effect['sentence']}")
    if effect.get("claim"):
        answer.tell(f"  {effect['claim']['sentence']}")
    narrow = " (too narrow)" if too_narrow else ""
    for name, row in effect["parameters"].items():
        held = " (held constant)" if row["fixed"] else f"   95 %{narrow}: {_range(row)}"
        unit = f" {row['unit']}" if row["unit"] not in ("", "1") else ""
        answer.say(f"  {name} = {number(row['value'])}{unit}{held}")
    for sentence in effect["evidence"]:
        answer.say(f"  {sentence}")
    others = other_laws(effect)
    for other in others:
        answer.tell(f"  cannot be distinguished from: {_alternative(other)}")
    if any(_differs(other) for other in others):
        answer.say("(an experiment at the point where they differ most could distinguish them)")
    elif others and all(other["difference"] is not None for other in others):
        answer.say("  (nothing in these data distinguishes them)")
    elif kind == "effect" and not effect["alternatives"]:
        answer.tell(f"  {NO_ALTERNATIVE}")


def _range(row: Facts) -> str:
    if row["at_bound"]:
        return f"at its {row['at_bound']} bound"
    low, high = row["lower95"], row["upper95"]
    if low is None or high is None:
        return "not determined"
    return f"{low:.5g} .. {high:.5g}"


def _differs(other: Facts) -> bool:
    """Return whether these data show any difference."""
    return other["difference"] is not None and bool(other["difference"] >= SAME_PREDICTION)


def _alternative(other: Facts) -> str:
    """Return an alternative, and the experiment that would distinguish it."""
    text = f"{other['words']} at {other['site']}"
    text += f": {other['equation']}" if other["equation"] else ""
    text += f"; with it, {other['parameters']}" if other.get("parameters") else ""
    if other["criterion"] is not None:
        better = f"; {BETTER}" if other.get("better") else ""
        text += f" (criterion {other['criterion']:+.1f}{better})"
    known = other["time"] is not None and other["difference"] is not None
    if known and other["difference"] < SAME_PREDICTION:
        return f"{text}; on these data, their predictions are the same"
    if other["experiment"] and known:
        text += (
            f"; they differ most in {other['experiment']} at {other['time']:.4g} s, "
            f"{other['output']} by {other['difference']:.2g} times the noise"
        )
    return text


def _print_parameters(answer: Answer, rows: Rows, *, too_narrow: bool) -> None:
    """Print values and intervals; intervals that are too narrow are marked."""
    found = "95 % interval (too narrow)" if too_narrow else "95 % interval"
    answer.rows(
        rows,
        ("parameter", "label"),
        ("before", numbers("value_before", "")),
        ("95 % interval", _before),
        ("after", numbers("value")),
        (found, interval),
        ("unit", "unit"),
        ("on", "estimated_on"),
        ("", at_bound),
    )


def _before(row: dict[str, Any]) -> str:
    low, high = row["lower95_before"], row["upper95_before"]
    return "" if math.isnan(low) or math.isnan(high) else f"{low:.5g} .. {high:.5g}"


def _print_errors(answer: Answer, rows: Rows, facts: Facts) -> None:
    lines = [
        [
            *(row[name] for name in ("experiment", "role", "output")),
            str(row["samples"]),
            *(_error(row, f"rmse_{when}") for when in ("before", "after")),
            row["unit"],
            *(_over_noise(row, when) for when in ("before", "after")),
        ]
        for row in rows
    ]
    for role, total in facts["errors"].items():
        if any(row["role"] == role for row in rows):
            pair = number(total["before"], UNKNOWN_NUMBER), number(total["after"], UNKNOWN_NUMBER)
            lines.append(["all", role, *[""] * 5, *pair])
    header = ["experiment", "role", "output", "samples", "RMSE before", "after", "unit"]
    answer.table([*header, f"over {facts['errors_over']} before", "after"], lines)
    answer.say("")


def _error(row: dict[str, Any], name: str) -> str:
    """Return an error; blank if there is no measurement to compare with."""
    return number(row[name]) if row["samples"] else ""


def _over_noise(row: dict[str, Any], when: str) -> str:
    """Return an error over the noise, which may be unknown; blank without a measurement."""
    if math.isnan(row[f"rmse_{when}"]):
        return _error(row, f"normalised_{when}")
    return number(row[f"normalised_{when}"], UNKNOWN_NUMBER)


def _other_noise(facts: Facts, rows: Rows) -> str:
    """Name the noise of the declared model if the errors are divided by it and it differs."""
    if not facts["effects"] or facts["errors_over"] != "estimated noise":
        return ""
    known = {r["output"]: r["rmse_after"] / r["normalised_after"] for r in rows if _has_noise(r)}
    differs = [
        f"{name} {number(level)}"
        for name, level in known.items()
        if abs(level - (facts["noise"].get(name) or level)) > NOTICEABLE * level
    ]
    over = "; the errors are divided by the noise estimated without the effects"
    return f"{over}: {', '.join(differs)}" if differs else ""


def _has_noise(row: dict[str, Any]) -> bool:
    return bool(row["rmse_after"] > 0.0 and row["normalised_after"] > 0.0)


NOTICEABLE = 0.02
"""Relative difference of two estimates of a noise that is worth a remark."""


def _print_rest(answer: Answer, facts: Facts, rows: Rows) -> None:
    """Print the rejected effects, the noise and the searched sites."""
    told = facts["summary"]  # it says once for all leads how often such leads were right
    for effect in facts["rejected"]:
        known = effect.get("claim") or {
            "sentence": "this shows where to look, but not what is missing"
        }
        said = "" if known["sentence"] in told else f"; {known['sentence']}"
        told += said
        answer.say(
            f"not accepted: {effect['form']} at {effect['site']}: {effect['equation']}{said}"
        )
        for other in other_laws(effect):
            answer.tell(f"  cannot be distinguished from: {_alternative(other)}")
    noise = ", ".join(
        f"{name} {number(value, UNKNOWN_NUMBER)}" for name, value in facts["noise"].items()
    )
    if noise:
        which = " with the effects" if facts["effects"] else ""
        answer.say(f"noise estimated from the residuals{which}: {noise}{_other_noise(facts, rows)}")
    if facts["sites"]:
        answer.say(f"searched sites: {', '.join(facts['sites'])}")
