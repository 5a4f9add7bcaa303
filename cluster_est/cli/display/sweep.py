"""A sweep's summary, for a terminal or a cron job's mail."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster_est.cli.display.run import number, print_table, say
from cluster_est.sweep.state import SUCCESS, SUMMARY

HEADER = ["run", "status", "cost", "RMSE train", "test", "evaluations", "seconds", ""]


def print_sweep(console: Console, out: Path, rows: list[dict[str, Any]], ran: int) -> None:
    """Print the number of runs that are done, and a line for each."""
    counts = Counter(row["status"] for row in rows)
    listed = ", ".join(f"{count} {status}" for status, count in counts.items())
    say(console, f"sweep {out}: {len(rows)} runs: {listed}; {ran} of them in this call")
    print_table(console, HEADER, [_cells(row) for row in rows])
    say(console, f"table: {out / SUMMARY}")


def _cells(row: dict[str, Any]) -> list[str]:
    numbers = [_shown(row.get(key)) for key in ("cost", "rmse_train", "rmse_test", "evaluations")]
    seconds = row.get("seconds")
    why = (row["message"].splitlines() or [""])[0]
    why = row["doubts"] if row["status"] == SUCCESS else why
    return [row["run"], row["status"], *numbers, "" if seconds is None else f"{seconds:.1f}", why]


def _shown(value: float | None) -> str:
    return "" if value is None else number(value)
