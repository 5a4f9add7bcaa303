"""A run in a terminal: sentences, numbers, tables without lines, and the tables of a fit."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster_est.errors import RunFolderError
from cluster_est.run_folder.run_files import Rows, StoredRun, left_alone, read_stored_run

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


def print_iterations(console: Console, run_folder: Path, search: str | None) -> None:
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
    print_rows(
        console,
        chosen,
        ("iteration", lambda row: row["ending"] or str(row["iteration"])),
        ("F-count", "evaluations"),
        *((name, _blank(key)) for name, key in (("f(x)", "cost"), ("max constraint", "violation"))),
        *((name, _blank(name)) for name in ("step", "optimality")),
    )


def _final_rank(row: dict[str, Any]) -> tuple[float, float]:
    from cluster_est.methods.method import TOLERANCE  # all methods: nothing that `show` waits for

    violation = row["violation"]
    violation = 0.0 if violation is None or math.isnan(violation) else violation
    return (violation if violation > TOLERANCE else 0.0, row["cost"])


def _blank(key: str) -> Cell:
    return lambda row: "" if row[key] is None or math.isnan(row[key]) else f"{row[key]:.6g}"


def _print_parameters(console: Console, rows: Rows, *, too_narrow: bool, interrupted: bool) -> None:
    """Print values and intervals; the latter with a word where the residuals deny them."""
    # without a single interval in a run that was cut short, none was computed
    computed = not interrupted or not all(math.isnan(row["lower95"]) for row in rows)
    column = "95 % interval (too narrow)" if too_narrow else "95 % interval"
    print_rows(
        console,
        rows,
        ("parameter", "label"),
        ("value", numbers("value")),
        (column, lambda row: interval(row) if computed else ""),
        ("unit", "unit"),
        ("start", numbers("start")),
        ("on", "estimated_on"),
        ("", at_bound),
    )


def _print_errors(console: Console, rows: Rows, missing: str) -> None:
    print_rows(
        console,
        rows,
        *((name, name) for name in ("experiment", "role", "output", "samples")),
        ("RMSE before", numbers("rmse_before", missing)),
        ("after", numbers("rmse_after", missing)),
        ("unit", "unit"),
        ("relative", lambda row: _percent(row["relative_after"])),
    )


def _print_constraints(console: Console, rows: Rows) -> None:
    if rows:
        print_rows(
            console,
            rows,
            ("constraint", "constraint"),
            ("must be", "kind"),
            ("before", numbers("before")),
            ("after", numbers("after")),
            ("", lambda row: "" if row["satisfied"] else "violated"),
        )


def _print_intervals(console: Console, rows: Rows) -> None:
    """Intervals that took refits."""
    if rows:
        print_rows(
            console,
            rows,
            ("parameter", "label"),
            ("from", "source"),
            ("confidence", lambda row: f"{100 * row['confidence']:.4g} %"),
            ("lower", lambda row: row["open_lower"] or _blank("lower")(row)),
            ("upper", lambda row: row["open_upper"] or _blank("upper")(row)),
        )


def _print_front(console: Console, rows: Rows) -> None:
    """The ends of a front of several objectives, and how many points lie between."""
    objectives = {row["point"]: row["objectives"] for row in rows}
    if objectives:
        columns = list(zip(*objectives.values(), strict=True))
        spans = ", ".join(f"{min(c):.5g} .. {max(c):.5g}" for c in columns)
        say(console, "")
        say(console, f"front of {len(objectives)} points, objectives {spans}: front.parquet")


def _print_minima(console: Console, starts: Rows, minima: Rows) -> None:
    """Print the number of starts that reached each minimum."""
    if not starts:
        return
    costs = {row["point"]: row["cost"] for row in minima}
    counts = Counter(row["minimum"] for row in starts)
    rows = [(str(point), number(cost), str(counts[point])) for point, cost in costs.items()]
    if counts[-1]:
        rows.append(("none", "", str(counts[-1])))
    print_table(console, ["minimum", "cost", f"starts of {len(starts)}"], rows)


Cell = Callable[[dict[str, Any]], str]
"""What stands in a column of a row."""


def print_rows(console: Console, rows: Rows, *columns: tuple[str, str | Cell]) -> None:
    """A table of rows: for each column its name, and a key of the rows or what makes its cells."""
    print_table(
        console,
        [name for name, _ in columns],
        [[str(row[of]) if isinstance(of, str) else of(row) for _, of in columns] for row in rows],
    )


def numbers(key: str, missing: str = "failed") -> Cell:
    """A column of numbers of six digits."""
    return lambda row: number(row[key], missing)


def at_bound(row: dict[str, Any]) -> str:
    """Whether a value stands at a bound."""
    return f"at its {row['at_bound']} bound" if row["at_bound"] else ""


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
