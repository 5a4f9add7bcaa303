"""The commands that run: fit, close-loop, sensitivity, sweep and simulate."""

from __future__ import annotations

import io
import sys
from argparse import Namespace
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from pyarrow import feather

from cluster_est.cli.answer import Answer, Cell
from cluster_est.cli.document import verdicts
from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.printed_runs import print_any_run
from cluster_est.cli.printing import number
from cluster_est.cli.terminal import (
    EXIT_CODES,
    alive,
    build_core,
    run_as_told,
    say_report,
    terminal_listener,
)
from cluster_est.config.build import build_problem
from cluster_est.config.choices import build_resources
from cluster_est.config.reader import config_folder, read_config
from cluster_est.config.sections import Config
from cluster_est.errors import RunFolderError
from cluster_est.problem.problem import Problem
from cluster_est.results.curves import residual_table, trajectory_table
from cluster_est.results.output_errors import Simulation
from cluster_est.run_folder.run_files import (
    SWEEP_SUMMARY_FILE,
    Rows,
    RunStatus,
    check_has_estimates,
    read_facts,
    read_run_table,
)
from cluster_est.run_folder.run_identity import RunKind
from cluster_est.studies.configured import read_study
from cluster_est.studies.fit import simulate as run_simulate
from cluster_est.sweep.matrix import NOT_RUN, SUCCESS
from cluster_est.sweep.sweep import sweep as run_sweep
from cluster_est.whole_files import write_output

OF_STUDIES = {
    "cost": "cost",
    "RMSE train": "rmse_train",
    "test": "rmse_test",
    "verdict": "verdict",
    "effects": "effects",
    "together": "together",
}
"""Columns of a sweep's table that only some studies have."""


def print_sweep(answer: Answer, out: Path, rows: Rows, ran: int) -> None:
    """Print the number of finished runs, and a line for each."""
    counts = Counter(row["status"] for row in rows)
    answer.add(**sweep_fields(out, rows, ran))
    listed = ", ".join(f"{count} {status}" for status, count in counts.items())
    answer.say(f"sweep {out}: {len(rows)} runs: {listed}; {ran} of them in this call")
    answer.rows(
        rows,
        ("run", "run"),
        ("status", "status"),
        *(
            (name, _known(key))
            for name, key in OF_STUDIES.items()
            if any(row.get(key) is not None for row in rows)
        ),
        ("evaluations", _known("evaluations")),
        ("seconds", lambda row: "" if row.get("seconds") is None else f"{row['seconds']:.1f}"),
        ("", _why),
    )
    answer.say(f"table: {out / SWEEP_SUMMARY_FILE}")
    answer.say(f"for one page about all runs, run: cluster-est report {out}")


def sweep_fields(out: Path, rows: Rows, ran: int) -> dict[str, Any]:
    """Return the fields of a sweep; each status and verdict has a count, which may be 0."""
    worst = {
        f"worst_{name}": max((r[name] for r in rows if r.get(name) is not None), default=None)
        for name in ("rmse_train", "rmse_test")
    }
    statuses = (NOT_RUN, *(each.value for each in RunStatus))
    return worst | {
        "out": out,
        "ran": ran,
        "runs": rows,
        "counts": {each: sum(r["status"] == each for r in rows) for each in statuses},
        "verdicts": {each: sum(r.get("verdict") == each for r in rows) for each in verdicts()},
        "doubtful": sum(bool(row["doubts"]) for row in rows),
    }


def _known(key: str) -> Cell:
    def cell(row: dict[str, Any]) -> str:
        value = row.get(key)
        return "" if value is None else value if isinstance(value, str) else number(value)

    return cell


def _why(row: dict[str, Any]) -> str:
    """Return the doubts about a run, or the first line of why it failed."""
    said = row["doubts"] if row["status"] == SUCCESS else (row["message"].splitlines() or [""])[0]
    return str(said)


def fit(options: Namespace, answer: Answer) -> int:
    """Estimate, write the run folder, print the tables."""
    return _run(options, answer, RunKind.FIT)


def close_loop(options: Namespace, answer: Answer) -> int:
    """Find what the model lacks, write the run folder, print what was found."""
    return _run(options, answer, RunKind.CLOSED_LOOP)


def sensitivity(options: Namespace, answer: Answer) -> int:
    """Rank what is estimated by how much it matters, write the run folder, print the ranking."""
    return _run(options, answer, RunKind.SENSITIVITY)


def _run(options: Namespace, answer: Answer, kind: RunKind) -> int:
    with alive(f"reading {options.config}"):
        run = read_study(options.config, options.overrides, kind, allow_code=options.allow_code)
    build_core(answer)
    end = run_as_told(run, options.out, options, answer)
    if end.stopped:
        answer.add(run=options.out, run_status=end.status, message=end.stopped)
    else:
        print_any_run(answer, options.out)
        say_report(answer, options.out)
    return EXIT_CODES[end.status]


def sweep(options: Namespace, answer: Answer) -> int:
    """Do what a sweep still lacks, and print a line for each of its runs."""
    build_core(answer)
    swept = run_sweep(
        options.sweep,
        options.out,
        lambda text: print(text, file=sys.stderr),
        terminal_listener(answer),
        retry_failed=options.retry_failed,
        allow_code=options.allow_code,
    )
    print_sweep(answer, options.out, swept.rows, swept.ran)
    if swept.interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.DONE if swept.success else ExitCode.NO_SOLUTION


def simulate(options: Namespace, answer: Answer) -> int:
    """Simulate every experiment and write one table of trajectories."""
    config, out = read_config(options.config, options.overrides), options.out
    resources = build_resources(config)
    for sentence in resources.notes():
        answer.complain(sentence)
    writer = _table_writer(out)
    if out.is_dir():
        raise RunFolderError(f"--out: {out} must be a file, but is a folder; choose a file")
    if options.run_folder is not None:
        config = _with_effects_of_run(config, options.run_folder, answer)
    base = config_folder(options.config)
    problem = build_problem(config, base, allow_code=options.allow_code)
    values = {} if options.run_folder is None else read_estimates(options.run_folder, problem)
    simulations = list(run_simulate(problem, resources, values).values())
    for simulation in simulations:
        if not simulation.outcome.ok:
            name = problem.experiments[simulation.experiment].id
            outcome = simulation.outcome
            answer.complain(f"experiment {name!r}: {outcome.status}: {outcome.message}")
    answer.add(experiments=[_simulated(problem, each) for each in simulations])
    good = tuple(s for s in simulations if s.outcome.ok)
    if not good:
        return ExitCode.NO_SOLUTION
    measured = residual_table(problem, good).drop_columns(["simulated", "role"])
    table = trajectory_table(problem, good).join(measured, ["experiment", "output", "time"])
    order = [("experiment", "ascending"), ("output", "ascending"), ("time", "ascending")]
    content = io.BytesIO()
    writer(table.sort_by(order), content)
    write_output(out, content.getvalue())
    answer.add(out=out, rows=table.num_rows)
    answer.say(f"{out}: {table.num_rows} rows")
    return ExitCode.DONE if len(good) == len(simulations) else ExitCode.NO_SOLUTION


def _with_effects_of_run(config: Config, run_folder: Path, answer: Answer) -> Config:
    """Add the effects that a closed loop found to the config, and say so."""
    from cluster_est.run_folder.logged_simulation import with_found_effects  # slow to load

    if not (run_folder / "run.json").is_file():
        return config  # a message on the estimates follows
    whole = with_found_effects(config, read_facts(run_folder))
    added = [section.name for section in whole.effects[len(config.effects) :]]
    if added:
        several = "effects" if len(added) > 1 else "effect"
        answer.complain(
            f"--run: the {several} {', '.join(added)} of the run in {run_folder} "
            f"{'are' if len(added) > 1 else 'is'} added to the config"
        )
    return whole


def _simulated(problem: Problem, simulation: Simulation) -> dict[str, Any]:
    outcome = simulation.outcome
    return {
        "id": problem.experiments[simulation.experiment].id,
        "status": str(outcome.status),
        "message": outcome.message,
    }


def read_estimates(run_folder: Path, problem: Problem) -> dict[str, float]:
    """Return physical values by label from a run's parameters.parquet.

    Raises
    ------
    RunFolderError
        If the run is not finished, or if it has estimated values that the problem lacks. Without an
        added effect, the other estimates mean little.
    """
    path = run_folder / "parameters.parquet"
    if not path.is_file():
        if (run_folder / "run.json").is_file():
            check_has_estimates(run_folder)
        raise RunFolderError(
            f"{run_folder}: must be the folder of a finished run, but is not; "
            "finish the run with --resume"
        )
    rows = [r for r in read_run_table(path) if r["estimated_on"] in ("train", "test")]
    known = {parameter.name for parameter in problem.parameters}
    strange = list(dict.fromkeys(r["label"] for r in rows if r["parameter"] not in known))
    if strange:
        raise RunFolderError(
            f"--run: the run in {run_folder} also estimated {', '.join(strange)}, which the config "
            f"does not declare; use the config of the run, {run_folder / 'config.toml'}"
        )
    return {row["label"]: row["value"] for row in rows}


def _table_writer(out: Path):  # type: ignore[no-untyped-def]
    writers = {
        ".parquet": partial(pq.write_table, write_page_checksum=True),
        ".feather": feather.write_feather,
        ".csv": pacsv.write_csv,
    }
    if out.suffix.lower() not in writers:
        raise RunFolderError(
            f"--out: must end in one of {', '.join(writers)}, but is {out.name!r}; rename it"
        )
    return writers[out.suffix.lower()]
