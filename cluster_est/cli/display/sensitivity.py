"""The ranking of a sensitivity analysis in a terminal."""

from __future__ import annotations

import math

from rich.console import Console

from cluster_est.cli.display.run import number, print_table, say
from cluster_est.run_folder.reading import StoredRun


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
