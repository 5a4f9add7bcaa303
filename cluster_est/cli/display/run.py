"""Tables for a terminal."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster_est.errors import RunFolderError
from cluster_est.run_folder.reading import StoredRun, left_alone, read_stored_run

SHOWN = (
    "parameters", "errors", "constraints", "intervals", "front", "starts", "minima", "ranking",
    "probabilities", "evidence", "precision", "prediction_precision",
)  # fmt: skip
"""Tables of a run that its summary is printed from."""


def print_run(console: Console, run: StoredRun) -> None:
    """Print a run's outcome, parameters and errors; `run` has the tables `SHOWN`."""
    facts, tables = run.facts, run.tables
    cut = facts["status"] == "interrupted"
    missing = "not simulated" if cut else "failed"
    say(console, f"run {run.path}: {facts['status']}")
    if facts.get("message"):
        say(console, f"  {facts['message']}")
    alone = left_alone(run.path, facts["status"])
    if alone:
        say(console, f"  {alone}")
    if {"cost_before", "cost", "iterations", "evaluations", "simulations"} <= facts.keys():
        say(
            console,
            f"  cost {number(facts['cost_before'], missing)} -> "
            f"{number(facts['cost'], missing)} in "
            f"{facts['iterations']} iterations, {facts['evaluations']} evaluations, "
            f"{facts['simulations']} simulations ({facts['failures']} failed), "
            f"{facts['seconds']:.1f} s",
        )
    if run.ended:
        narrow = bool((facts.get("residuals") or {}).get("too_narrow"))
        _print_parameters(console, tables["parameters"], too_narrow=narrow, interrupted=cut)
        _print_errors(console, tables["errors"], missing)
        _print_constraints(console, tables["constraints"])
        _print_intervals(console, tables["intervals"])
        _print_front(console, tables["front"])
        _print_minima(console, tables["starts"], tables["minima"])
        for note in facts.get("notes") or []:
            say(console, f"note: {note}")
        say(console, f"tables: {run.path}/*.parquet")


def print_iterations(console: Console, run_folder: Path, search: str | None = None) -> None:
    """Print the iteration table of one search, of the best start if none is named.

    Raises
    ------
    RunFolderError
        If there is no such search.
    """
    rows = read_stored_run(run_folder, ["searches"]).tables["searches"]
    names = list(dict.fromkeys(row["search"] for row in rows))
    if search is None:
        ended = [row for row in rows if row["ending"] and row["cost"] is not None]
        fits = [row for row in ended if row["search"] not in ("screen", "starts", "test")]
        search = min(fits, key=_final_rank)["search"] if fits else "train"
    if search not in names:
        from workers.fmu.description import nearest

        raise RunFolderError(f"{run_folder}: has no search {search!r}{nearest(search, names)}")
    chosen = [row for row in rows if row["search"] == search]
    header = ["iteration", "F-count", "f(x)", "max constraint", "step", "optimality"]
    print_table(
        console,
        header,
        [
            (
                str(row["iteration"]) if not row["ending"] else row["ending"],
                str(row["evaluations"]),
                *(_blank(row[key]) for key in ("cost", "violation", "step", "optimality")),
            )
            for row in chosen
        ],
    )


def _final_rank(row: dict[str, Any]) -> tuple[float, float]:
    from cluster_est.methods.method import TOLERANCE  # all methods: nothing that `show` waits for

    violation = row["violation"]
    violation = 0.0 if violation is None or math.isnan(violation) else violation
    return (violation if violation > TOLERANCE else 0.0, row["cost"])


def _blank(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.6g}"


def _print_parameters(
    console: Console, rows: list[dict[str, Any]], *, too_narrow: bool, interrupted: bool
) -> None:
    """Print values and intervals; the latter with a word where the residuals deny them."""
    # without a single interval in a run that was cut short, none was computed
    computed = not interrupted or not all(math.isnan(row["lower95"]) for row in rows)
    column = "95 % interval (too narrow)" if too_narrow else "95 % interval"
    header = ["parameter", "value", column, "unit", "start", "on", ""]
    print_table(
        console,
        header,
        [
            (
                row["label"],
                number(row["value"]),
                interval(row) if computed else "",
                row["unit"],
                number(row["start"]),
                row["estimated_on"],
                f"at its {row['at_bound']} bound" if row["at_bound"] else "",
            )
            for row in rows
        ],
    )


def _print_errors(console: Console, rows: list[dict[str, Any]], missing: str) -> None:
    header = ["experiment", "role", "output", "samples", "RMSE before", "after", "unit", "relative"]
    print_table(
        console,
        header,
        [
            (
                row["experiment"],
                row["role"],
                row["output"],
                str(row["samples"]),
                number(row["rmse_before"], missing),
                number(row["rmse_after"], missing),
                row["unit"],
                _percent(row["relative_after"]),
            )
            for row in rows
        ],
    )


def _print_constraints(console: Console, rows: list[dict[str, Any]]) -> None:
    if rows:
        header = ["constraint", "must be", "before", "after", ""]
        print_table(
            console,
            header,
            [
                (
                    row["constraint"],
                    row["kind"],
                    number(row["before"]),
                    number(row["after"]),
                    "" if row["satisfied"] else "violated",
                )
                for row in rows
            ],
        )


def _print_intervals(console: Console, rows: list[dict[str, Any]]) -> None:
    """Intervals that took refits."""
    if rows:
        header = ["parameter", "from", "confidence", "lower", "upper"]
        print_table(
            console,
            header,
            [
                (
                    row["label"],
                    row["source"],
                    f"{100 * row['confidence']:.4g} %",
                    row["open_lower"] or _blank(row["lower"]),
                    row["open_upper"] or _blank(row["upper"]),
                )
                for row in rows
            ],
        )


def _print_front(console: Console, rows: list[dict[str, Any]]) -> None:
    """The ends of a front of several objectives, and how many points lie between."""
    objectives = {row["point"]: row["objectives"] for row in rows}
    if objectives:
        columns = list(zip(*objectives.values(), strict=True))
        spans = ", ".join(f"{min(c):.5g} .. {max(c):.5g}" for c in columns)
        say(console, "")
        say(console, f"front of {len(objectives)} points, objectives {spans}: front.parquet")


def _print_minima(
    console: Console, starts: list[dict[str, Any]], minima: list[dict[str, Any]]
) -> None:
    """Print the number of starts that reached each minimum."""
    if not starts:
        return
    costs = {row["point"]: row["cost"] for row in minima}
    counts = Counter(row["minimum"] for row in starts)
    rows = [(str(point), number(cost), str(counts[point])) for point, cost in costs.items()]
    if counts[-1]:
        rows.append(("none", "", str(counts[-1])))
    print_table(console, ["minimum", "cost", f"starts of {len(starts)}"], rows)


def print_table(console: Console, header: list[str], rows: Iterable[Iterable[str]]) -> None:
    """A table without lines; no cell is cut, however narrow the terminal."""
    lines = [header, *([*row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    say(console, "")
    for line in lines:
        cells = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        say(console, "  ".join(cells).rstrip())


def say(console: Console, text: str) -> None:
    """One line, however narrow the terminal."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def tell(console: Console, text: str) -> None:
    """A sentence: broken between words in a terminal, one line elsewhere."""
    if console.is_terminal and len(text) > console.width:
        indent = " " * (len(text) - len(text.lstrip()) + 4)
        text = textwrap.fill(
            text,
            console.width,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
    say(console, text)


def _percent(share: float) -> str:
    return "" if math.isnan(share) else f"{100 * share:.3g} %"


def number(value: float | None, missing: str = "failed") -> str:
    """Six digits, or what is said of a number that is not there."""
    return missing if value is None or math.isnan(value) else f"{value:.6g}"


def interval(row: dict[str, Any]) -> str:
    """The 95 % interval of a row of parameters.parquet."""
    low, high = row["lower95"], row["upper95"]
    if row["estimated_on"] in ("known", "derived") and math.isnan(low):
        return ""
    if row["at_bound"]:
        return ""
    return "not determined" if math.isnan(low) else f"{low:.5g} .. {high:.5g}"
