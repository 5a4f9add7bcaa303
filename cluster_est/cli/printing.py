"""A fit as sentences and tables, and the format of numbers."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

from cluster_est.cli.answer import Answer, Cell
from cluster_est.errors import RunFolderError
from cluster_est.run_folder.run_files import Rows, StoredRun, left_alone, read_stored_run

SHOWN = (
    "parameters", "errors", "constraints", "intervals", "front", "starts", "minima", "ranking",
    "probabilities", "evidence", "precision", "prediction_precision",
)  # fmt: skip
"""Tables of a run for its summary."""


def print_run(answer: Answer, run: StoredRun) -> None:
    """Print a run's outcome, parameters and errors; `run` has the tables `SHOWN`."""
    facts, tables = run.facts, run.tables
    cut = facts["status"] == "interrupted"
    missing = "not simulated" if cut else "failed"
    answer.say(f"run {run.path}: {facts['status']}")
    if facts.get("message"):
        answer.say(f"  {facts['message']}")
    alone = left_alone(run.path, facts["status"])
    if alone:
        answer.say(f"  {alone}")
    if {"cost_before", "cost", "iterations", "evaluations", "simulations"} <= facts.keys():
        answer.say(
            f"  cost {number(facts['cost_before'], missing)} -> "
            f"{number(facts['cost'], missing)} in "
            f"{facts['iterations']} iterations, {facts['evaluations']} evaluations, "
            f"{facts['simulations']} simulations ({facts['failures']} failed), "
            f"{facts['seconds']:.1f} s",
        )
    if run.ended:
        narrow = bool((facts.get("residuals") or {}).get("too_narrow"))
        _print_parameters(answer, tables["parameters"], too_narrow=narrow, interrupted=cut)
        _print_errors(answer, tables["errors"], missing)
        _print_constraints(answer, tables["constraints"])
        _print_intervals(answer, tables["intervals"])
        _print_front(answer, tables["front"])
        _print_minima(answer, tables["starts"], tables["minima"])
        for note in facts.get("notes") or []:
            answer.say(f"note: {note}")
        answer.say(f"tables: {run.path}/*.parquet")


def print_iterations(answer: Answer, run_folder: Path, search: str | None) -> None:
    """Print the iteration table of one search, by default that of the best start.

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
    answer.add(run=run_folder, iteration_rows=chosen)
    answer.rows(
        chosen,
        ("iteration", lambda row: row["ending"] or str(row["iteration"])),
        ("F-count", "evaluations"),
        *((name, _blank(key)) for name, key in (("f(x)", "cost"), ("max constraint", "violation"))),
        *((name, _blank(name)) for name in ("step", "optimality")),
    )


def _final_rank(row: dict[str, Any]) -> tuple[float, float]:
    from cluster_est.methods.method import TOLERANCE  # imports all methods

    violation = row["violation"]
    violation = 0.0 if violation is None or math.isnan(violation) else violation
    return (violation if violation > TOLERANCE else 0.0, row["cost"])


def _blank(key: str) -> Cell:
    return lambda row: "" if row[key] is None or math.isnan(row[key]) else f"{row[key]:.6g}"


def _print_parameters(answer: Answer, rows: Rows, *, too_narrow: bool, interrupted: bool) -> None:
    """Print values and intervals; intervals that are too narrow are marked."""
    # without any interval in an interrupted run, none was computed
    computed = not interrupted or not all(math.isnan(row["lower95"]) for row in rows)
    column = "95 % interval (too narrow)" if too_narrow else "95 % interval"
    answer.rows(
        rows,
        ("parameter", "label"),
        ("value", numbers("value")),
        (column, lambda row: interval(row) if computed else ""),
        ("unit", "unit"),
        ("start", numbers("start")),
        ("on", "estimated_on"),
        ("", at_bound),
    )


def _print_errors(answer: Answer, rows: Rows, missing: str) -> None:
    answer.rows(
        rows,
        *((name, name) for name in ("experiment", "role", "output", "samples")),
        ("RMSE before", numbers("rmse_before", missing)),
        ("after", numbers("rmse_after", missing)),
        ("unit", "unit"),
        ("relative", lambda row: _percent(row["relative_after"])),
    )


def _print_constraints(answer: Answer, rows: Rows) -> None:
    if rows:
        answer.rows(
            rows,
            ("constraint", "constraint"),
            ("must be", "kind"),
            ("before", numbers("before")),
            ("after", numbers("after")),
            ("", lambda row: "" if row["satisfied"] else "violated"),
        )


def _print_intervals(answer: Answer, rows: Rows) -> None:
    """Print intervals from refits."""
    if rows:
        answer.rows(
            rows,
            ("parameter", "label"),
            ("from", "source"),
            ("confidence", lambda row: f"{100 * row['confidence']:.4g} %"),
            ("lower", lambda row: row["open_lower"] or _blank("lower")(row)),
            ("upper", lambda row: row["open_upper"] or _blank("upper")(row)),
        )


def _print_front(answer: Answer, rows: Rows) -> None:
    """Print the ends of a front of several objectives, and the number of points between them."""
    objectives = {row["point"]: row["objectives"] for row in rows}
    if objectives:
        columns = list(zip(*objectives.values(), strict=True))
        spans = ", ".join(f"{min(c):.5g} .. {max(c):.5g}" for c in columns)
        answer.say("")
        answer.say(f"front of {len(objectives)} points, objectives {spans}: front.parquet")


def _print_minima(answer: Answer, starts: Rows, minima: Rows) -> None:
    """Print the number of starts that reached each minimum."""
    if not starts:
        return
    costs = {row["point"]: row["cost"] for row in minima}
    counts = Counter(row["minimum"] for row in starts)
    rows = [(str(point), number(cost), str(counts[point])) for point, cost in costs.items()]
    if counts[-1]:
        rows.append(("none", "", str(counts[-1])))
    answer.table(["minimum", "cost", f"starts of {len(starts)}"], rows)


def numbers(key: str, missing: str = "failed") -> Cell:
    """Return a column of numbers with six digits."""
    return lambda row: number(row[key], missing)


def at_bound(row: dict[str, Any]) -> str:
    """Return whether a value is at a bound."""
    return f"at its {row['at_bound']} bound" if row["at_bound"] else ""


def _percent(share: float) -> str:
    return "" if math.isnan(share) else f"{100 * share:.3g} %"


def number(value: float | None, missing: str = "failed") -> str:
    """Return a number with six digits, or the text for a missing number."""
    return missing if value is None or math.isnan(value) else f"{value:.6g}"


def interval(row: dict[str, Any]) -> str:
    """Return the 95 % interval of a row of parameters.parquet."""
    low, high = row["lower95"], row["upper95"]
    if row["estimated_on"] in ("known", "derived") and math.isnan(low):
        return ""
    if row["at_bound"]:
        return ""
    return "not determined" if math.isnan(low) else f"{low:.5g} .. {high:.5g}"
