"""The findings of a closed loop in a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster_est.cli.display.run import SHOWN, interval, number, print_run, print_table, say, tell
from cluster_est.closed_loop.findings.words.numbers import NO_ALTERNATIVE, percent
from cluster_est.experiment_design.design_sentences import times
from cluster_est.run_folder.reading import StoredRun, read_stored_run


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
        print_table(
            console,
            ["if this is right, its probability", "now", "after it", "after a random input"],
            [
                (row["model"], *(_percent(row[name]) for name in ("before", "after", "random")))
                for row in models
            ],
        )
        first = models[0]["model"]
        print_table(
            console,
            [f"rival of {first}", "expected to be less likely by", "after a random input"],
            [
                (row["rival"], times(row["evidence"]), times(row["random"]))
                for row in run.tables["evidence"]
                if row["true_model"] == first
            ],
        )
    print_table(
        console,
        ["parameter", "unit", "value", "std error now", "after it", "after a random input"],
        [
            (
                row["label"],
                row["unit"],
                number(row["value"], ""),
                *(
                    number(row[name], "")
                    for name in ("std_error_before", "std_error_after", "random")
                ),
            )
            for row in run.tables["precision"]
        ],
    )
    if run.tables["prediction_precision"]:
        print_table(
            console,
            ["predicted", "of", "unit", "std deviation now", "after it", "after a random input"],
            [
                (
                    row["output"],
                    row["experiment"],
                    row["unit"],
                    *(
                        number(row[name], "")
                        for name in ("std_error_before", "std_error_after", "random")
                    ),
                )
                for row in run.tables["prediction_precision"]
            ],
        )
    for note in facts["notes"][1:]:
        say(console, f"note: {note}")
    say(console, f"tables: {run.path}/*.parquet")


def _percent(value: float) -> str:
    return "" if math.isnan(value) else percent(value)


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
    rows = run.tables["ranking"]
    header = ["parameter", found["ranks"], "+-", "seen, in sigmas", "collinearity"]
    print_table(
        console,
        [*header, "estimate"],
        [
            (
                row["label"],
                number(row["value"], "none"),
                number(row["half_width"], ""),
                number(row["size"], ""),
                _index(row["collinearity"]),
                _together(row["position"], row["together"]),
            )
            for row in rows
        ],
    )
    for note in facts.get("notes") or []:
        say(console, f"note: {note}")
    say(console, f"tables: {run.path}/*.parquet")


def _index(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    return "cannot be told" if math.isinf(value) else f"{value:.3g}"


def _together(position: int, together: bool) -> str:
    """In which place, where an order is known."""
    if position < 0:
        return ""
    return f"{position + 1}." if together else "no"


Facts = Mapping[str, Any]

UNKNOWN = "unknown"

SAME = 0.1
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
    for said in ["", *choices] if choices else []:  # runs of earlier versions do not say
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
    failed, tried = facts["failures"], facts.get("failures_in_search", 0)
    if not tried:
        return f"{failed} failed"
    which = "all" if tried == failed else str(tried)
    return f"{failed} failed, {which} while effects were tried"


def _print_effect(console: Console, effect: Facts, *, too_narrow: bool = False) -> None:
    say(console, "")
    named = effect.get("words") or effect["family"]  # runs of earlier versions have no words
    say(console, f"effect {effect['name']} ({named}) at {effect['site']}")
    tell(console, f"  {effect.get('sentence') or effect['equation']}")
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
    if row.get("at_bound"):  # runs of earlier versions do not say
        return f"at its {row['at_bound']} bound"
    low, high = row["lower95"], row["upper95"]
    if low is None or high is None:
        return "not determined"
    return f"{low:.5g} .. {high:.5g}"


def _differs(other: Facts) -> bool:
    """Return whether these data show a difference at all."""
    return other["difference"] is not None and bool(other["difference"] >= SAME)


def _alternative(other: Facts) -> str:
    """An alternative, and the experiment that would tell it apart."""
    text = f"{other.get('words') or other['form']} at {other['site']}: {other['equation']}"
    if other["criterion"] is not None:
        text += f" (criterion {other['criterion']:+.1f})"
    known = other["time"] is not None and other["difference"] is not None
    if known and other["difference"] < SAME:
        return f"{text}; on these data they predict the same"
    if other["experiment"] and known:
        text += (
            f"; they differ most in {other['experiment']} at {other['time']:.4g} s, "
            f"{other['output']} by {other['difference']:.2g} times the noise"
        )
    return text


def _print_parameters(console: Console, rows: list[dict[str, Any]], *, too_narrow: bool) -> None:
    """Print values and intervals; the last ones with a word where the residuals deny them."""
    found = "95 % interval (too narrow)" if too_narrow else "95 % interval"
    header = ["parameter", "before", "95 % interval", "after", found, "unit", "on", ""]
    print_table(
        console,
        header,
        [
            (
                row["label"],
                _or_blank(row["value_before"]),
                _before(row),
                number(row["value"]),
                interval(row),
                row["unit"],
                row["estimated_on"],
                f"at its {row['at_bound']} bound" if row["at_bound"] else "",
            )
            for row in rows
        ],
    )


def _or_blank(value: float) -> str:
    return "" if math.isnan(value) else number(value)


def _before(row: dict[str, Any]) -> str:
    low, high = row["lower95_before"], row["upper95_before"]
    return "" if math.isnan(low) or math.isnan(high) else f"{low:.5g} .. {high:.5g}"


def _print_errors(console: Console, rows: list[dict[str, Any]], facts: Facts) -> None:
    over = facts["errors_over"]
    lines = [
        (
            row["experiment"],
            row["role"],
            row["output"],
            str(row["samples"]),
            _error(row, "rmse_before"),
            _error(row, "rmse_after"),
            row["unit"],
            _over_noise(row, "before"),
            _over_noise(row, "after"),
        )
        for row in rows
    ]
    for role, total in facts["errors"].items():
        if any(row["role"] == role for row in rows):
            pair = number(total["before"], UNKNOWN), number(total["after"], UNKNOWN)
            lines.append(("all", role, "", "", "", "", "", *pair))
    header = ["experiment", "role", "output", "samples", "RMSE before", "after", "unit"]
    print_table(console, [*header, f"over {over} before", "after"], lines)
    say(console, "")


def _error(row: dict[str, Any], name: str) -> str:
    """An error; blank where nothing was measured that a simulation could miss."""
    return number(row[name]) if row["samples"] else ""


def _over_noise(row: dict[str, Any], when: str) -> str:
    """An error over the noise, which may be unknown, or none, where a simulation did not fail."""
    if math.isnan(row[f"rmse_{when}"]):
        return _error(row, f"normalised_{when}")
    return number(row[f"normalised_{when}"], UNKNOWN)


def _print_rest(console: Console, facts: Facts) -> None:
    """Print the effects that did not pass, the noise and the open sites."""
    for effect in facts["rejected"]:
        say(
            console,
            f"not accepted: {effect['form']} at {effect['site']}: {effect['equation']}; it shows "
            "where to look, not what is missing",
        )
    noise = ", ".join(f"{name} {number(value, UNKNOWN)}" for name, value in facts["noise"].items())
    if noise:
        say(console, f"noise estimated from the residuals: {noise}")
    say(console, f"open sites: {', '.join(facts['sites'])}")
