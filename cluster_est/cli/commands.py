"""What the commands do. Only this file and the display print."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.feather
import pyarrow.parquet
from rich.console import Console

from cluster_est.cli.loop_printing import print_any_run
from cluster_est.cli.preflight_printing import print_page
from cluster_est.cli.printing import (
    print_check,
    print_iterations,
    print_model,
    print_run,
    read_run_table,
    say,
)
from cluster_est.cli.progress import ProgressLine
from cluster_est.cli.reading import read_config
from cluster_est.cli.replay_printing import print_answer, print_failures, print_question
from cluster_est.cli.run_keeper import Keeper
from cluster_est.cli.sweep_printing import print_sweep
from cluster_est.config.build import (
    build_method,
    build_multistart,
    build_problem,
    build_resources,
    build_settings,
    build_uncertainty,
)
from cluster_est.config.reader import Config
from cluster_est.drafting import draft, unit_mismatches, write
from cluster_est.errors import BudgetError, ConfigError, ModelError, ProblemError, RunFolderError
from cluster_est.fit import check_search
from cluster_est.fit import fit as run_fit
from cluster_est.fit import simulate as run_simulate
from cluster_est.preflight import SECONDS, CheckFinding, CheckPage, bare_problem, examine
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import make_space
from cluster_est.results.curves import residual_table, trajectory_table
from cluster_est.run_folder.replay import prepare, read_logged
from cluster_est.run_folder.replay import replay as run_replay
from cluster_est.running.interrupts import stopped_by
from cluster_est.running.resources import Resources

DONE, NO_SOLUTION, INTERRUPTED = 0, 1, 130
STOP = "stop"
"""File in a run folder that ends the run as Ctrl-C does."""


def init(fmu: Path, data: list[Path], out: Path | None, *, overwrite: bool) -> int:
    """Write a first config, and say what to fill in or to do next."""
    out = Path(f"{fmu.stem}.toml") if out is None else out
    if out.is_dir():
        raise ConfigError(f"--out: {out} must be a file but is a folder; name a file in it")
    if out.exists() and not overwrite:
        raise ConfigError(
            f"--out: {out} is there already; choose another, or replace it with --overwrite"
        )
    found = draft(fmu, data)
    text = write(found, out.parent)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text.toml, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written ({error}); choose another") from error
    console = Console()
    for number, line in text.open:
        say(console, f"{out}, line {number}: fill in {line.partition('  # ')[0]}")
    for name in dict.fromkeys(name for run in found.runs for name in run.unfed):
        where = ", ".join(repr(run.id) for run in found.runs if name in run.unfed)
        say(console, f"{out}: no column of {where} is like input {name!r}; it stays as it starts")
    say(console, f"{out} is written; look through it, then: cluster-est check {out}")
    return DONE


def check(path: Path, overrides: list[str], *, allow_code: bool, seconds: float = SECONDS) -> int:
    """Read everything, try the FMU out in processes of its own, print a page; change nothing."""
    console = Console()
    if path.suffix.lower() == ".fmu":
        bare = bare_problem(path)
        print_model(console, bare, "its own start values")
        page = examine(bare, Resources(), seconds, declared=False)
        print_page(console, page)
        return _verdict(page)
    config = read_config(path, overrides)
    problem = build_problem(config, path.parent, allow_code=allow_code)
    method = build_method(config)
    check_search(problem, method, build_uncertainty(config), build_multistart(config))
    make_space(problem, problem.indices("test"))
    page = examine(problem, build_resources(config), seconds)
    page = replace(page, findings=(*page.findings, *_units(config, problem)))
    print_model(console, problem, f"method {method.name}")
    if page.simulations:
        print_check(console, problem, page.simulations)
    print_page(console, page)
    return _verdict(page)


def _units(config: Config, problem: Problem) -> list[CheckFinding]:
    """A line for each column whose name says another unit than its variable has."""
    return [
        CheckFinding(
            "problem",
            "units",
            f"column '{m.column}' is given to {m.variable}, which is in {m.wanted}, as it is",
            f'columns."{m.column}" = {{ factor = {m.change.factor:.12g}, '
            f"offset = {m.change.offset:.12g} }}; with factor = 1 alone if the name is wrong",
        )
        for m in unit_mismatches(config, problem.describe())
    ]


def _verdict(page: CheckPage) -> int:
    if not page.loads:
        raise ModelError(page.findings[0].found)
    return DONE if page.good else NO_SOLUTION


def fit(
    path: Path,
    overrides: list[str],
    out: Path,
    *,
    overwrite: bool,
    resume: bool,
    allow_code: bool,
    with_report: bool = True,
) -> int:
    """Estimate, write the run folder, print the tables."""
    config = read_config(path, overrides)
    problem = build_problem(config, path.parent, allow_code=allow_code)
    method = build_method(config)
    multistart, uncertainty = build_multistart(config), build_uncertainty(config)
    check_search(problem, method, uncertainty, multistart)
    make_space(problem, problem.indices("test"))
    keeper = Keeper(
        out,
        problem,
        config,
        path.parent,
        "closed_loop",
        overwrite=overwrite,
        resume=resume,
        with_report=with_report,
    )
    if keeper.finished:
        print_run(Console(), out)
        keeper.name_report()
        return DONE
    resources = keeper.resources(config)
    progress = ProgressLine(Console(stderr=True), resources.budget)
    with progress as line, keeper, stopped_by(out / STOP):
        result = run_fit(
            problem,
            method,
            resources,
            config.method.seed,
            keeper.record,
            keeper.shown(line.show),
            keeper.note,
            multistart,
            uncertainty,
        )
        if keeper.folder is not None:
            keeper.folder.write(result)
    print_run(Console(), out)
    keeper.name_report()
    if result.interrupted:
        return INTERRUPTED
    return DONE if result.success else NO_SOLUTION


def close_loop(
    path: Path,
    overrides: list[str],
    out: Path,
    *,
    overwrite: bool,
    resume: bool,
    allow_code: bool,
    with_report: bool = True,
) -> int:
    """Find what the model lacks, write the run folder, print what was found."""
    from cluster_est.closed_loop.loop import close_loop as run_loop  # needs SymPy, which is slow

    config = read_config(path, overrides)
    problem = build_problem(config, path.parent, allow_code=allow_code)
    settings = build_settings(config)
    make_space(problem, problem.indices("test"))
    keeper = Keeper(
        out,
        problem,
        config,
        path.parent,
        "method",
        overwrite=overwrite,
        resume=resume,
        with_report=with_report,
    )
    if keeper.finished:
        print_any_run(Console(), out)
        keeper.name_report()
        return DONE
    resources = keeper.resources(config)
    try:
        progress = ProgressLine(Console(stderr=True), resources.budget)
        with progress as line, keeper, stopped_by(out / STOP):
            seed = config.closed_loop.seed
            result = run_loop(
                problem,
                resources,
                settings,
                seed,
                keeper.record,
                keeper.shown(line.show),
                keeper.note,
            )
            if keeper.folder is not None:
                keeper.folder.write_loop(result)
    except (KeyboardInterrupt, BudgetError, ProblemError) as error:
        if keeper.folder is None:  # nothing was simulated: the input is to blame
            raise
        stopped = isinstance(error, KeyboardInterrupt)
        what = "interrupted" if stopped else str(error)
        say(Console(stderr=True), f"cluster-est: {what}; {keeper.steps}; the log is in {out}")
        return INTERRUPTED if stopped else NO_SOLUTION
    print_any_run(Console(), out)
    keeper.name_report()
    return DONE


def simulate(
    path: Path, overrides: list[str], out: Path, run_folder: Path | None, *, allow_code: bool
) -> int:
    """Simulate every experiment and write one table of trajectories."""
    config = read_config(path, overrides)
    writer = _table_writer(out)
    if out.is_dir():
        raise RunFolderError(f"--out: {out} must be a file but is a folder; choose another")
    problem = build_problem(config, path.parent, allow_code=allow_code)
    values = {} if run_folder is None else read_estimates(run_folder, problem)
    simulations = run_simulate(problem, build_resources(config), values)
    for simulation in simulations:
        if not simulation.outcome.ok:
            name = problem.experiments[simulation.experiment].id
            outcome = simulation.outcome
            Console(stderr=True, soft_wrap=True).print(
                f"cluster-est: experiment {name!r}: {outcome.status}: {outcome.message}",
                markup=False,
                highlight=False,
            )
    good = tuple(s for s in simulations if s.outcome.ok)
    if not good:
        return NO_SOLUTION
    measured = residual_table(problem, good).drop_columns(["simulated", "role"])
    table = trajectory_table(problem, good).join(measured, ["experiment", "output", "time"])
    order = [("experiment", "ascending"), ("output", "ascending"), ("time", "ascending")]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        writer(table.sort_by(order), out)
    except OSError as error:
        raise RunFolderError(f"--out: {out} cannot be written ({error}); choose another") from error
    Console(soft_wrap=True).print(f"{out}: {table.num_rows} rows", markup=False, highlight=False)
    return DONE if len(good) == len(simulations) else NO_SOLUTION


def replay(run_folder: Path, number: int, config: Path | None, *, allow_code: bool) -> int:
    """Run one logged simulation again, in a process of its own that shows the FMU's messages."""
    logged = read_logged(run_folder, number)
    question = prepare(run_folder, logged, config, allow_code=allow_code)
    print_question(Console(), logged, question)
    outcome = run_replay(question)
    print_answer(Console(), logged, outcome)
    return DONE if outcome.ok else NO_SOLUTION


def show(run_folder: Path, *, iterations: bool, search: str | None, failures: bool) -> int:
    """Print the tables of a run, what failed in it, or one search's iterations."""
    if failures:
        print_failures(Console(), run_folder)
    elif iterations:
        print_iterations(Console(), run_folder, search)
    else:
        print_any_run(Console(), run_folder)
    return DONE


def report(run_folder: Path, out: Path | None) -> int:
    """Write the report of a run."""
    from cluster_est.report import write_report  # not everybody wants to wait for Jinja

    say(Console(), f"report: {write_report(run_folder, out)}")
    return DONE


def watch(run_folder: Path, every: float, *, html: bool) -> int:
    """Follow a run until it ends."""
    from cluster_est.report.watch import follow
    from cluster_est.report.watch_printing import WatchTable

    with WatchTable(Console()) as table:
        follow(run_folder, every, table.show, html=html)
    return DONE


def sweep(path: Path, out: Path, *, retry_failed: bool, allow_code: bool) -> int:
    """Do what a sweep still lacks, and print a line for each of its runs."""
    from cluster_est.sweep.sweep import sweep as run_sweep

    errors = Console(stderr=True)
    swept = run_sweep(
        path,
        out,
        lambda text: say(errors, text),
        lambda budget: ProgressLine(errors, budget),
        retry_failed=retry_failed,
        allow_code=allow_code,
    )
    print_sweep(Console(), out, swept.rows, swept.ran)
    if swept.interrupted:
        return INTERRUPTED
    return DONE if swept.success else NO_SOLUTION


def export(
    run_folder: Path,
    config: Path | None,
    experiment: str | None,
    *,
    fmu: Path | None,
    ssv: Path | None,
    modelica: bool,
    text: bool,
    allow_code: bool,
) -> int:
    """Write what a run has found, in the forms that are asked for."""
    from cluster_est.export.write import ExportRequest
    from cluster_est.export.write import export as run_export  # SymPy takes long to import

    wanted = ExportRequest(fmu, ssv, modelica, text)
    written = run_export(run_folder, config, experiment, wanted, allow_code=allow_code)
    for printed in written.printed:
        say(Console(), printed)
    for note in written.notes:
        say(Console(stderr=True), f"cluster-est: {note}")
    for path in written.files:
        say(Console(stderr=True), f"{path}")
    return DONE


def read_estimates(run_folder: Path, problem: Problem) -> dict[str, float]:
    """Physical values by label from a run's parameters.parquet.

    Raises
    ------
    RunFolderError
        If the run is not finished, or has estimated what the problem does not have: without an
        effect that the run has added, its other values mean little.
    """
    path = run_folder / "parameters.parquet"
    if not path.is_file():
        raise RunFolderError(f"{run_folder}: must be the folder of a finished run but is not")
    rows = [r for r in read_run_table(path) if r["estimated_on"] in ("train", "test")]
    known = {parameter.name for parameter in problem.parameters}
    strange = list(dict.fromkeys(r["label"] for r in rows if r["parameter"] not in known))
    if strange:
        raise RunFolderError(
            f"--run: {run_folder} must have estimated what the config declares but has "
            f"{', '.join(strange)} besides; add the run's [[effects]] and parameters to the config"
        )
    return {row["label"]: row["value"] for row in rows}


def _table_writer(out: Path):  # type: ignore[no-untyped-def]
    writers = {
        ".parquet": pa.parquet.write_table,
        ".feather": pa.feather.write_feather,
        ".csv": pa.csv.write_csv,
    }
    if out.suffix.lower() not in writers:
        raise RunFolderError(
            f"--out: must end in one of {', '.join(writers)} but is {out.name!r}; rename it"
        )
    return writers[out.suffix.lower()]
