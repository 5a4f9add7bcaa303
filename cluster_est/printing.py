"""Tables for a terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from cluster_est.errors import RunFolderError
from cluster_est.methods.base import Method
from cluster_est.problem import Problem
from cluster_est.result import Simulation
from cluster_est.space import make_space


def print_run(console: Console, run_folder: Path) -> None:
    """A run's outcome, parameters and errors.

    Raises
    ------
    RunFolderError
        If there is no run.
    """
    facts = read_facts(run_folder)
    say(console, f"run {run_folder}: {facts['status']}")
    if facts.get("message"):
        say(console, f"  {facts['message']}")
    if {"cost_before", "cost", "iterations", "evaluations", "simulations"} <= facts.keys():
        say(
            console,
            f"  cost {number(facts['cost_before'])} -> {number(facts['cost'])} in "
            f"{facts['iterations']} iterations, {facts['evaluations']} evaluations, "
            f"{facts['simulations']} simulations ({facts['failures']} failed), "
            f"{facts['seconds']:.1f} s",
        )
    tables = [run_folder / f"{name}.parquet" for name in ("parameters", "errors")]
    if all(path.is_file() for path in tables):
        _print_parameters(console, read_run_table(tables[0]))
        _print_errors(console, read_run_table(tables[1]))
        say(console, f"tables: {run_folder}/*.parquet")


def read_run_table(path: Path) -> list[dict[str, Any]]:
    """The rows of one of a run's tables.

    Raises
    ------
    RunFolderError
        If it is damaged.
    """
    try:
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise RunFolderError(f"{path}: is damaged ({error}); run again") from error
    return rows


def print_check(
    console: Console, problem: Problem, method: Method, simulations: list[Simulation]
) -> None:
    """What `check` found: model, unknowns, experiments and one simulation of each."""
    model = problem.model
    say(
        console,
        f"{model.name}: {model.interface.replace('_', ' ')}, solver {model.solver.name}; "
        f"method {method.name}",
    )
    train = make_space(problem, problem.indices("train"))
    say(
        console,
        f"{train.size} unknowns; a forward Jacobian costs {len(train.colours)} points x "
        f"{len(train.experiments)} experiments",
    )
    rows = []
    for simulation in simulations:
        experiment, outcome = problem.experiments[simulation.experiment], simulation.outcome
        rows.append(
            (
                experiment.id,
                experiment.role,
                f"{experiment.start:g} .. {experiment.stop:g}",
                str(experiment.size),
                number(outcome.seconds * 1e3),
                outcome.message or str(outcome.status),
            )
        )
    print_table(console, ["experiment", "role", "seconds", "samples", "ms", "simulated"], rows)


def read_facts(run_folder: Path) -> dict[str, Any]:
    """What run.json says.

    Raises
    ------
    RunFolderError
        If there is none, or it is damaged.
    """
    path = run_folder / "run.json"
    if not path.is_file():
        raise RunFolderError(f"{run_folder}: must be the folder of a run but has no run.json")
    try:
        facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        facts["status"]
    except (ValueError, KeyError, TypeError) as error:
        raise RunFolderError(f"{path}: is damaged ({error}); run again") from error
    return facts


def _print_parameters(console: Console, rows: list[dict[str, Any]]) -> None:
    header = ["parameter", "value", "95 % interval", "unit", "start", "on", ""]
    print_table(
        console,
        header,
        [
            (
                row["label"],
                number(row["value"]),
                interval(row),
                row["unit"],
                number(row["start"]),
                row["estimated_on"],
                f"at its {row['at_bound']} bound" if row["at_bound"] else "",
            )
            for row in rows
        ],
    )


def _print_errors(console: Console, rows: list[dict[str, Any]]) -> None:
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
                number(row["rmse_before"]),
                number(row["rmse_after"]),
                row["unit"],
                f"{100 * row['relative_after']:.3g} %",
            )
            for row in rows
        ],
    )


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


def number(value: float | None) -> str:
    """Six digits."""
    return "failed" if value is None or math.isnan(value) else f"{value:.6g}"


def interval(row: dict[str, Any]) -> str:
    """The 95 % interval of a row of parameters.parquet."""
    low, high = row["lower95"], row["upper95"]
    if row["estimated_on"] == "known" or row["at_bound"]:
        return ""
    return "not determined" if math.isnan(low) else f"{low:.5g} .. {high:.5g}"
