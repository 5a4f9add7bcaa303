"""A run of any kind in a terminal: a fit, a closed loop, a sensitivity analysis, a design."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster_est.cli.printing import (
    SHOWN,
    Cell,
    at_bound,
    interval,
    number,
    numbers,
    print_rows,
    print_run,
    print_table,
    say,
    tell,
)
from cluster_est.experiment_design.design_sentences import times
from cluster_est.problem.display import NO_ALTERNATIVE, percent
from cluster_est.run_folder.run_files import Rows, StoredRun, read_stored_run


def print_design(console: Console, run: StoredRun) -> None:
    """Print what was chosen, and what it is expected to tell.

    `run` has the tables "probabilities", "evidence", "precision" and
    "prediction_precision".
    """
    facts = run.facts
    tell(console, f"next experiment: {facts['design']['summary']}")
    say(
        console,
        f"run {run.path}: {facts['simulations']} simulations ({facts['failures']} failed), "
        f"{facts['seconds']:.1f} s",
    )
    models = run.tables["probabilities"]
    if models:
        print_rows(
            console,
            models,
            ("if this is right, its probability", "model"),
            ("now", _percents("before")),
            ("after it", _percents("after")),
            ("after a random input", _percents("random")),
        )
        first = models[0]["model"]
        print_rows(
            console,
            [row for row in run.tables["evidence"] if row["true_model"] == first],
            (f"rival of {first}", "rival"),
            ("expected to be less likely by", lambda row: times(row["evidence"])),
            ("after a random input", lambda row: times(row["random"])),
        )
    then = (
        ("after it", numbers("std_error_after", "")),
        ("after a random input", numbers("random", "")),
    )
    print_rows(
        console,
        run.tables["precision"],
        ("parameter", "label"),
        ("unit", "unit"),
        ("value", numbers("value", "")),
        ("std error now", numbers("std_error_before", "")),
        *then,
    )
    if run.tables["prediction_precision"]:
        print_rows(
            console,
            run.tables["prediction_precision"],
            ("predicted", "output"),
            ("of", "experiment"),
            ("unit", "unit"),
            ("std deviation now", numbers("std_error_before", "")),
            *then,
        )
    for note in facts["notes"][1:]:
        say(console, f"note: {note}")
    say(console, f"tables: {run.path}/*.parquet")


def _percents(key: str) -> Cell:
    return lambda row: "" if math.isnan(row[key]) else percent(row[key])


def print_sensitivity(console: Console, run: StoredRun) -> None:
    """Print the unknowns by what they move, which go together, and what to know.

    `run` has the table "ranking".
    """
    facts = run.facts
    found = facts["sensitivity"]
    say(
        console,
        f"run {run.path}: {found['method']}, {found['groups']} groups of points, "
        f"{facts['simulations']} simulations ({facts['failures']} failed), "
        f"{facts['seconds']:.1f} s",
    )
    print_rows(
        console,
        run.tables["ranking"],
        ("parameter", "label"),
        (found["ranks"], numbers("value", "none")),
        ("+-", numbers("half_width", "")),
        ("seen, in sigmas", numbers("size", "")),
        ("collinearity", lambda row: _index(row["collinearity"])),
        ("estimate", lambda row: _together(row["position"], row["together"])),
    )
    for note in facts.get("notes") or []:
        say(console, f"note: {note}")
    say(console, f"tables: {run.path}/*.parquet")


def _index(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return UNKNOWN_NUMBER if math.isinf(value) else f"{value:.3g}"


def _together(position: int, together: bool) -> str:
    """In which place, where an order is known."""
    if position < 0:
        return ""
    return f"{position + 1}." if together else "no"


Facts = Mapping[str, Any]

UNKNOWN_NUMBER = "unknown"

SAME_PREDICTION = 0.1
"""Times the noise below which two predictions count as the same."""


def print_any_run(console: Console, run_folder: Path) -> None:
    """Print a run of any kind.

    Raises
    ------
    RunFolderError
        If there is no run.
    """
    run = read_stored_run(run_folder, SHOWN)
    if run.facts.get("sensitivity"):
        print_sensitivity(console, run)
    elif run.facts.get("design"):
        print_design(console, run)
    elif run.facts.get("verdict"):
        print_loop(console, run)
    else:
        print_run(console, run)


def print_loop(console: Console, run: StoredRun) -> None:
    """Verdict, effects, parameters, errors before and after, and what to know."""
    facts = run.facts
    tell(console, f"verdict: {facts['verdict']}: {facts['summary']}")
    say(
        console,
        f"run {run.path}: {facts['simulations']} simulations ({_failed(facts)}), "
        f"{facts['seconds']:.1f} s",
    )
    narrow = facts["verdict"] == "unexplained"  # they do not allow for what is missing
    for effect in facts["effects"]:
        _print_effect(console, effect, too_narrow=narrow)
    choices = [facts[key] for key in ("likely", "resampled") if facts.get(key)]
    for said in ["", *choices] if choices else []:
        tell(console, said)
    _print_parameters(console, run.tables["parameters"], too_narrow=narrow)
    _print_errors(console, run.tables["errors"], facts)
    for note in facts["notes"]:
        say(console, f"note: {note}")
    _print_rest(console, facts)
    if facts["effects"]:
        say(console, "")
        say(console, "to name what was found in the config, so that cluster-est fit estimates it:")
        say(console, "")
        say(console, "\n".join(effect["config"] for effect in facts["effects"]))
    say(console, f"tables: {run.path}/*.parquet")


def _failed(facts: Facts) -> str:
    """How many simulations failed, and how many of these with effects that were only tried."""
    failed, tried = facts["failures"], facts["failures_in_search"]
    if not tried:
        return f"{failed} failed"
    which = "all" if tried == failed else str(tried)
    return f"{failed} failed, {which} while effects were tried"


def _print_effect(console: Console, effect: Facts, *, too_narrow: bool) -> None:
    say(console, "")
    say(console, f"effect {effect['name']} ({effect['words']}) at {effect['site']}")
    tell(console, f"  {effect['sentence']}")
    narrow = " (too narrow)" if too_narrow else ""
    for name, row in effect["parameters"].items():
        held = " (held)" if row["fixed"] else f"   95 %{narrow}: {_range(row)}"
        unit = f" {row['unit']}" if row["unit"] not in ("", "1") else ""
        say(console, f"  {name} = {number(row['value'])}{unit}{held}")
    for sentence in effect["evidence"]:
        say(console, f"  {sentence}")
    for other in effect["alternatives"]:
        tell(console, f"  cannot be told apart from: {_alternative(other)}")
    if any(_differs(other) for other in effect["alternatives"]):
        say(console, "  (an experiment that stays where they differ most would tell them apart)")
    elif effect["alternatives"]:
        say(console, "  (nothing in these data tells them apart)")
    else:
        tell(console, f"  {NO_ALTERNATIVE}")


def _range(row: Facts) -> str:
    if row["at_bound"]:
        return f"at its {row['at_bound']} bound"
    low, high = row["lower95"], row["upper95"]
    if low is None or high is None:
        return "not determined"
    return f"{low:.5g} .. {high:.5g}"


def _differs(other: Facts) -> bool:
    """Return whether these data show a difference at all."""
    return other["difference"] is not None and bool(other["difference"] >= SAME_PREDICTION)


def _alternative(other: Facts) -> str:
    """An alternative, and the experiment that would tell it apart."""
    text = f"{other['words']} at {other['site']}: {other['equation']}"
    if other["criterion"] is not None:
        text += f" (criterion {other['criterion']:+.1f})"
    known = other["time"] is not None and other["difference"] is not None
    if known and other["difference"] < SAME_PREDICTION:
        return f"{text}; on these data they predict the same"
    if other["experiment"] and known:
        text += (
            f"; they differ most in {other['experiment']} at {other['time']:.4g} s, "
            f"{other['output']} by {other['difference']:.2g} times the noise"
        )
    return text


def _print_parameters(console: Console, rows: Rows, *, too_narrow: bool) -> None:
    """Print values and intervals; the last ones with a word where the residuals deny them."""
    found = "95 % interval (too narrow)" if too_narrow else "95 % interval"
    print_rows(
        console,
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


def _print_errors(console: Console, rows: Rows, facts: Facts) -> None:
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
    print_table(console, [*header, f"over {facts['errors_over']} before", "after"], lines)
    say(console, "")


def _error(row: dict[str, Any], name: str) -> str:
    """An error; blank where nothing was measured that a simulation could miss."""
    return number(row[name]) if row["samples"] else ""


def _over_noise(row: dict[str, Any], when: str) -> str:
    """An error over the noise, which may be unknown, or none, where a simulation did not fail."""
    if math.isnan(row[f"rmse_{when}"]):
        return _error(row, f"normalised_{when}")
    return number(row[f"normalised_{when}"], UNKNOWN_NUMBER)


def _print_rest(console: Console, facts: Facts) -> None:
    """Print the effects that did not pass, the noise and the open sites."""
    for effect in facts["rejected"]:
        say(
            console,
            f"not accepted: {effect['form']} at {effect['site']}: {effect['equation']}; it shows "
            "where to look, not what is missing",
        )
    noise = ", ".join(
        f"{name} {number(value, UNKNOWN_NUMBER)}" for name, value in facts["noise"].items()
    )
    if noise:
        say(console, f"noise estimated from the residuals: {noise}")
    say(console, f"open sites: {', '.join(facts['sites'])}")
