"""The commands that run: fit, close-loop, sensitivity and sweep."""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster_est.cli.display.closed_loop import print_any_run
from cluster_est.cli.display.run import number, print_table, say
from cluster_est.cli.exit_codes import ExitCode
from cluster_est.cli.terminal import (
    complain,
    say_if_compiled_first,
    say_if_filter_compiled_first,
    terminal_listener,
)
from cluster_est.run_folder.context import Existing
from cluster_est.run_folder.judgement import RunStatus
from cluster_est.run_folder.run_identity import RunKind
from cluster_est.studies.configured import Destination, do_run, read_study
from cluster_est.sweep.matrix import SUCCESS, SUMMARY
from cluster_est.sweep.sweep import sweep as run_sweep

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


EXIT_CODES = {
    RunStatus.DONE: ExitCode.DONE,
    RunStatus.NOT_CONVERGED: ExitCode.NO_SOLUTION,
    RunStatus.FAILED: ExitCode.NO_SOLUTION,
    RunStatus.INTERRUPTED: ExitCode.INTERRUPTED,
}


def fit(options: Namespace) -> int:
    """Estimate, write the run folder, print the tables."""
    return _run(options, RunKind.FIT)


def close_loop(options: Namespace) -> int:
    """Find what the model lacks, write the run folder, print what was found."""
    return _run(options, RunKind.CLOSED_LOOP)


def sensitivity(options: Namespace) -> int:
    """Rank what is estimated by how much it matters, write the run folder, print the ranking."""
    return _run(options, RunKind.SENSITIVITY)


def _run(options: Namespace, kind: RunKind) -> int:
    run = read_study(options.config, options.overrides, kind, allow_code=options.allow_code)
    existing = Existing.OVERWRITE if options.overwrite else Existing.REFUSE
    existing = Existing.RESUME if options.resume else existing
    to = Destination(options.out, existing, report=not options.no_report)
    say_if_compiled_first()
    say_if_filter_compiled_first(run.identity.problem)
    end = do_run(run, to, terminal_listener())
    if end.stopped:
        complain(end.stopped)
        return EXIT_CODES[end.status]
    print_any_run(Console(), options.out)
    if (options.out / "report.html").is_file():
        say(Console(), f"report: {options.out / 'report.html'}")
    return EXIT_CODES[end.status]


def sweep(options: Namespace) -> int:
    """Do what a sweep still lacks, and print a line for each of its runs."""
    say_if_compiled_first()
    swept = run_sweep(
        options.sweep,
        options.out,
        lambda text: say(Console(stderr=True), text),
        terminal_listener(),
        retry_failed=options.retry_failed,
        allow_code=options.allow_code,
    )
    print_sweep(Console(), options.out, swept.rows, swept.ran)
    if swept.interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.DONE if swept.success else ExitCode.NO_SOLUTION
