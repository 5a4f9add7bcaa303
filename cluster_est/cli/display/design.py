"""The design of the next experiment in a terminal."""

from __future__ import annotations

import math

from rich.console import Console

from cluster_est.cli.display.run import number, print_table, say, tell
from cluster_est.closed_loop.findings.words.numbers import percent
from cluster_est.experiment_design.findings.sentences import times
from cluster_est.run_folder.reading import StoredRun


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
